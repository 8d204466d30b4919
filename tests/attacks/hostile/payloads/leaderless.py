"""Leave a process behind whose main thread has ended: it looks like a zombie, and runs on."""

import ctypes
import os
import threading
import time

from payloads.running import call_me


def attack(alias):
    read, write = os.pipe()
    if os.fork() == 0:
        os.setsid()
        call_me(alias)
        threading.Thread(target=_run_on, args=(write,)).start()
        ctypes.CDLL(None).pthread_exit(None)
    os.read(read, 1)


def _run_on(write):
    ctypes.CDLL(None).pthread_join(ctypes.c_ulong(threading.main_thread().ident), None)
    os.write(write, b"x")
    os.closerange(0, 256)
    time.sleep(300)

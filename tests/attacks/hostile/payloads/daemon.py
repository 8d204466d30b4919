"""Leave a process behind that nobody is the parent of, and that asks for no death signal."""

import ctypes
import os
import signal
import time

from payloads.running import call_me

_PR_SET_PDEATHSIG = 1


def attack(alias):
    read, write = os.pipe()
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, 0, 0, 0, 0)
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
                signal.signal(number, signal.SIG_IGN)
            call_me(alias)
            os.write(write, b"x")
            os.closerange(0, 256)
            time.sleep(300)
        os._exit(0)
    os.read(read, 1)

"""Keep forking away: by the time that one process is found, it is another one."""

import os
import time

from payloads.running import call_me


def attack(alias, seconds):
    if os.fork() == 0:
        os.setsid()
        call_me(alias)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.05)  # a test must be able to see it, too
            if os.fork() != 0:
                os._exit(0)
        os._exit(0)
    time.sleep(0.1)

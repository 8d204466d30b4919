"""Fork, and have the children stay."""

import os
import time


def attack(count):
    forked = 0
    for _ in range(count):
        try:
            pid = os.fork()
        except OSError as error:
            return [forked, str(error)]
        if pid == 0:
            try:
                time.sleep(300)
            finally:
                os._exit(0)
        forked += 1
    return forked

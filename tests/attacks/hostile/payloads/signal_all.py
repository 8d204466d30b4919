"""Send a signal to every process that may be reached. SIGWINCH is one that nobody minds, and not
the one that those who are attacked one by one count."""

import os
import signal


def attack():
    os.kill(-1, signal.SIGWINCH)

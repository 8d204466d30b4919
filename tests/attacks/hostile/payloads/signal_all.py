"""Send a signal to every process that may be reached. SIGURG is one that nobody minds."""

import os
import signal


def attack():
    os.kill(-1, signal.SIGURG)

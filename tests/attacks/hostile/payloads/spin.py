"""Burn processor time, and ignore the polite request to stop."""

import signal
import time


def attack(seconds):
    signal.signal(signal.SIGXCPU, signal.SIG_IGN)
    while time.process_time() < seconds:
        pass
    return time.process_time()

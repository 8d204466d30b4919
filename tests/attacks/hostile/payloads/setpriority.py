"""Make another process slow."""

import os


def attack(pid, nice):
    os.setpriority(os.PRIO_PROCESS, pid, nice)

"""Give another process the lowest of scheduling classes."""

import os


def attack(pid):
    os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))

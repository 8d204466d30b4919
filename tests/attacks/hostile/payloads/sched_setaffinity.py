"""Tie another process to one core."""

import os


def attack(pid, cpus):
    os.sched_setaffinity(pid, cpus)

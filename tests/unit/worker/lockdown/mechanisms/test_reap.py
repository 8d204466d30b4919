"""Ending all processes below one."""

import os
import signal
import subprocess
import sys
import time

import pytest

from envhub_worker.lockdown.mechanisms import procfs, reap

TREE = """
import os, time
for _ in range(2):
    if os.fork() == 0:
        os.setsid()
        break
print("up", flush=True)
time.sleep(600)
"""


def test_a_child_after_the_last_look_is_killed_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fork that had begun when its process was stopped may end after we looked, at any time."""
    monkeypatch.setattr(reap, "PATIENCE_S", 1.0)
    with subprocess.Popen([sys.executable, "-c", TREE], stdout=subprocess.PIPE) as root:
        for _ in range(3):
            root.stdout.readline()
        first, second = procfs.descendants(root.pid)
        looks, look = iter(range(3)), procfs.all_children

        def late() -> procfs.Children:
            seen = look()
            number = next(looks, None)
            if number is not None:
                time.sleep(number * 0.6)  # as on a machine that is starved
                return {pid: [one for one in below if one != second] for pid, below in seen.items()}
            return seen

        monkeypatch.setattr(procfs, "all_children", late)
        reap.kill_descendants(root=root.pid)
        states = [_state(pid) for pid in (root.pid, first, second)]
        os.kill(root.pid, signal.SIGKILL)
    assert states == ["S", "Z", "Z"]


LEADERLESS = """
import ctypes, os, threading, time
if os.fork() == 0:
    main = ctypes.c_ulong(threading.main_thread().ident)
    def run_on():
        ctypes.CDLL(None).pthread_join(main, None)
        os.write(1, b"up\\n")
        time.sleep(600)
    threading.Thread(target=run_on).start()
    ctypes.CDLL(None).pthread_exit(None)
time.sleep(600)
"""


def test_a_process_whose_first_thread_has_ended_is_killed_too() -> None:
    with subprocess.Popen([sys.executable, "-c", LEADERLESS], stdout=subprocess.PIPE) as root:
        assert root.stdout.readline() == b"up\n"
        (pid,) = procfs.descendants(root.pid)
        assert (_state(pid), len(os.listdir(f"/proc/{pid}/task"))) == ("Z", 2)
        reap.kill_descendants(root=root.pid)
        threads = os.listdir(f"/proc/{pid}/task")
        os.kill(root.pid, signal.SIGKILL)
    assert threads == [str(pid)]


def _state(pid: int) -> str:
    with open(f"/proc/{pid}/stat") as stat:
        return stat.read().rpartition(")")[2].split()[0]

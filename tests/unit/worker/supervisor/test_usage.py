"""What a server counts of its jails for those who ask, and how often."""

from __future__ import annotations

import os
import subprocess
import sys

from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.supervisor.usage import CountLimit, usage_of


def test_who_asks_too_often_is_not_counted_for() -> None:
    """Some at once, and then as many as the server has time for; no more are saved up."""
    time = [0.0]
    counting = CountLimit(lambda: time[0])

    def granted() -> int:
        count = 0
        while counting.children() is not None:
            count += 1
        return count

    at_once = granted()
    assert at_once > 8
    time[0] += 1.0
    a_second = granted()
    assert 0 < a_second < at_once
    time[0] += 3600.0
    assert granted() == at_once


def test_one_look_does_for_all() -> None:
    """What is below a process is found in what was seen before."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        children = procfs.all_children()
        held = usage_of(os.getpid(), [process.pid], children)
        assert process.pid in procfs.descendants(os.getpid(), children=children)
        assert held["processes"] >= 1
        assert held["memory_bytes"] > 0
        assert held["files"] >= 3, "its standard streams"
        process.communicate(b"\n")
    assert usage_of(0, [], children) == {}

"""What a server counts of its jails, how often, and which limits it says that they have come to.
Here with this process for a runner."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from envhub_worker.lockdown.limits.cgroups import Group
from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.protocol.confinement import Limits
from envhub_worker.supervisor.usage import CountLimit, reached, usage_of

_NONE: dict[str, int] = {}


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
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        children = procfs.all_children()
        held = usage_of(os.getpid(), [process.pid], children)
        assert process.pid in procfs.descendants(os.getpid(), children=children)
        assert held["processes"] >= 1
        assert held["memory_bytes"] > 0
        assert held["files"] >= 3, "its standard streams"
        process.communicate(b"\n")
    assert usage_of(0, [], children) == {}
    cycle = {1: [2, 4], 2: [3], 3: [2, 1], 4: [5]}  # pids reused between two looks at /proc
    assert procfs.descendants(1, keep=[4], children=cycle) == [2, 3]


def come_to(limits: Limits, usage: dict[str, int] = _NONE, *, own_root: bool = False) -> list[str]:
    return list(reached(limits, usage, [os.getpid()], own_root=own_root))


def test_processes_and_threads_count_alike() -> None:
    few = Limits(processes=10, open_files=1 << 20)
    assert come_to(few, {"processes": 4, "threads": 5, "memory_bytes": 0}) == []
    assert come_to(few, {"processes": 4, "threads": 6, "memory_bytes": 0}) == ["PROCESSES"]
    assert come_to(few) == []


def test_a_pipe_takes_two_of_the_open_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procfs, "descriptors", lambda pid: 20)
    assert come_to(Limits(open_files=22)) == []
    assert come_to(Limits(open_files=21)) == ["OPEN_FILES"]


@pytest.mark.parametrize(
    ("blocks", "files", "expected"),
    [(1000, 10, []), (3, 10, ["DISK_BYTES"]), (1000, 0, ["DISK_FILES"])],
)
def test_a_scratch_is_full_or_has_no_names_left(
    monkeypatch: pytest.MonkeyPatch, blocks: int, files: int, expected: list[str]
) -> None:
    left = SimpleNamespace(f_bavail=blocks, f_frsize=4096, f_ffree=files)
    monkeypatch.setattr(os, "statvfs", lambda path: left)
    wide = Limits(open_files=1 << 20)
    assert come_to(wide, own_root=True) == expected
    assert come_to(wide) == []


@pytest.mark.parametrize("kind", ["cgroup-v1", "cgroup-v2"])
def test_a_control_group_counts_what_it_refused(tmp_path: Path, kind: str) -> None:
    folders = [f"{tmp_path}/{name}" for name in ("memory", "pids")][-1 if "2" in kind else 0 :]
    group = Group(kind, folders, Limits())
    assert not group.refused()
    events = Path(folders[-1], "pids.events")
    for text, refused in (("max 0\n", False), ("max 2\n", True), ("", False)):
        events.write_text(text)
        assert group.refused() == refused

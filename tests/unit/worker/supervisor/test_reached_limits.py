"""Which limits a server says a jail has come to: here, with this process for a runner."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from envhub_worker.lockdown.limits.cgroups import Group
from envhub_worker.protocol.confinement import Limits
from envhub_worker.supervisor.usage import reached

_NONE: dict[str, int] = {}


def told(limits: Limits, usage: dict[str, int] = _NONE, *, own_root: bool = False) -> list[str]:
    """Of a jail whose one runner is this process."""
    return list(reached(limits, usage, [os.getpid()], own_root=own_root))


def test_processes_and_threads_count_alike() -> None:
    """And where nobody has counted nothing is said."""
    few = Limits(processes=10, open_files=1 << 20)
    assert told(few, {"processes": 4, "threads": 5, "memory_bytes": 0}) == []
    assert told(few, {"processes": 4, "threads": 6, "memory_bytes": 0}) == ["PROCESSES"]
    assert told(few) == []


def test_a_pipe_takes_two_of_the_open_files() -> None:
    """So that the last one is nobody's."""
    held = len(os.listdir("/proc/self/fd"))
    assert told(Limits(open_files=held + 50)) == []
    assert told(Limits(open_files=held - 5)) == ["OPEN_FILES"]


@pytest.mark.parametrize(
    ("blocks", "files", "expected"),
    [(1000, 10, []), (3, 10, ["DISK_BYTES"]), (1000, 0, ["DISK_FILES"])],
)
def test_a_scratch_is_full_or_has_no_names_left(
    monkeypatch: pytest.MonkeyPatch, blocks: int, files: int, expected: list[str]
) -> None:
    """Where it is a file system of its own."""
    left = SimpleNamespace(f_bavail=blocks, f_frsize=4096, f_ffree=files)
    monkeypatch.setattr(os, "statvfs", lambda path: left)
    wide = Limits(open_files=1 << 20)
    assert told(wide, own_root=True) == expected
    assert told(wide) == []


@pytest.mark.parametrize("kind", ["cgroup-v1", "cgroup-v2"])
def test_a_control_group_counts_what_it_refused(tmp_path: Path, kind: str) -> None:
    """One that counts nothing, or has gone, has refused nothing."""
    folders = [f"{tmp_path}/{name}" for name in ("memory", "pids")][-1 if "2" in kind else 0 :]
    group = Group(kind, folders, Limits())
    assert not group.refused()
    events = Path(folders[-1], "pids.events")
    for text, refused in (("max 0\n", False), ("max 2\n", True), ("", False)):
        events.write_text(text)
        assert group.refused() == refused

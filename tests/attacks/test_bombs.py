"""Taking more than the limits give: processes, memory, disk, processor time, output.

The controls are tame: they take a little more than the limits of the jail, and no more.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from envhub_sandbox.errors import WorkerDiedError
from tests.attacks.harness import (
    USER,
    Arena,
    Run,
    call,
    control_run,
    new_alias,
    start_control,
)
from tests.support.processes import eventually

FAMILY = "Bombs"

MIB = 1 << 20
MEMORY, BOMB = 256 * MIB, 448 * MIB
PROCESSES, FORKS = 32, 80
DISK, FILL = 16 * MIB, 64 * MIB
FILES, INODES = 300, 1500
CPU_S, SPIN_S = 1, 3.0


@pytest.mark.parametrize(("title", "payload"), [("fork", "fork_bomb"), ("thread", "thread_bomb")])
def test_fork_bomb_stops_at_the_limit(arena: Arena, title: str, payload: str) -> None:
    """Processes and threads together never exceed the limit."""
    arena.attack(
        f"{title} bomb",
        payload,
        lambda run: tasks(run) > PROCESSES,
        limits={"processes": PROCESSES},
        count=FORKS,
    )


def stays(run: Run, over: Callable[[Run], bool]) -> bool:
    """Whether a run stays over a limit: what is only measured is noticed a moment later."""
    return over(run) and not (run.inside and eventually(lambda: not over(run), 4.0))


def tasks(run: Run) -> int:
    """Live threads of all processes of a run."""
    count = 0
    for pid in run.pids():
        with contextlib.suppress(OSError):
            count += len(os.listdir(f"/proc/{pid}/task"))
    return count


KINDS = ("heap", "shared", "memfd", "memfd in flight", "System V", "children", "pipes")


@pytest.mark.parametrize("kind", KINDS)
def test_memory_bomb_stops_at_the_limit(arena: Arena, kind: str) -> None:
    """All memory counts: private, shared, in files without a name, of all processes together."""
    no_pipes = "the kernel limits a plain user's pipes by itself"
    arena.attack(
        f"memory bomb: {kind}",
        "memory_bomb",
        lambda run: stays(run, lambda run: memory(run) > MEMORY + 64 * MIB),
        limits={"memory_bytes": MEMORY, "processes": 128, "open_files": 65536},
        impossible=no_pipes if kind == "pipes" and USER == "user" else "",
        kind=kind,
        size=BOMB,
    )


def memory(run: Run) -> int:
    """What the processes of a run hold, mapped or open, as far as it can be seen from here.

    What waits in sockets and pipes cannot: there the bomb's own count has to do, if it lives.
    """
    held = 0
    inodes = set()
    for pid in run.pids():
        with contextlib.suppress(OSError):
            held += proportional(pid)
            for fd in os.listdir(f"/proc/{pid}/fd"):
                status = os.stat(f"/proc/{pid}/fd/{fd}")
                if "memfd" in os.readlink(f"/proc/{pid}/fd/{fd}"):
                    inodes.add((status.st_ino, status.st_blocks * 512))
    held += sum(size for _, size in inodes)
    return max(held, run.value if isinstance(run.value, int) and run.pids() else 0)


def proportional(pid: int) -> int:
    """A process's share of the memory that it maps."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    return 0


def test_memory_bomb_does_not_hurt_the_neighbours(arena: Arena) -> None:
    """The jail that takes too much dies with a clear reason; another one steps on."""
    with arena.environment() as other:
        other.reset()
        with (
            arena.environment(limits={"memory_bytes": MEMORY}) as env,
            pytest.raises(WorkerDiedError, match="memory") as caught,
        ):
            env.call("attack", "memory_bomb", {"kind": "heap", "size": BOMB}, new_alias())
        other.step([0])
    assert caught.value.reason == "out-of-memory"


@pytest.fixture
def places(home: Path) -> list[str]:
    """Folders for the controls to fill."""
    folders = [home / name for name in ("one", "two")]
    for folder in folders:
        folder.mkdir()
    return [str(folder) for folder in folders]


def test_disk_cannot_be_filled(arena: Arena, places: list[str]) -> None:
    """All that a jail writes, in whatever folders, stays below its limit."""

    def written(run: Run) -> int:
        [pid, *_] = run.pids() or [0]
        root = f"/proc/{pid}/root" if run.inside else ""
        files = [entry[0] for entry in (run.value or {}).values()]
        return sum(blocks(f"{root}{path}") for path in files)

    arena.attack(
        "fill the disk",
        "fill_disk",
        lambda run: stays(run, lambda run: written(run) > 2 * DISK),
        limits={"disk_bytes": DISK, "memory_bytes": 1024 * MIB},
        inside={"folders": []},
        folders=places,
        size=FILL,
    )


def blocks(path: str) -> int:
    """What a file takes up."""
    with contextlib.suppress(OSError):
        return os.stat(path).st_blocks * 512
    return 0


def test_inodes_cannot_be_used_up(arena: Arena, places: list[str]) -> None:
    """Nor does a flood of empty files get further than its limit."""

    def made(run: Run) -> int:
        [pid, *_] = run.pids() or [0]
        root = f"/proc/{pid}/root" if run.inside else ""
        count = 0
        for folder, *_ in (run.value or {}).values():
            with contextlib.suppress(OSError):
                count += len(os.listdir(f"{root}{folder}")) if folder else 0
        return count

    arena.attack(
        "use up the inodes",
        "fill_inodes",
        lambda run: stays(run, lambda run: made(run) > 2 * FILES),
        limits={"disk_files": FILES},
        inside={"folders": []},
        folders=places,
        count=INODES,
    )


def test_processor_time_runs_out(arena: Arena) -> None:
    """A process that burns more than its seconds is killed, ignore the warning as it may."""
    arena.attack(
        "burn processor time",
        "spin",
        lambda run: isinstance(run.value, float) and run.value >= SPIN_S,
        limits={"cpu_s": CPU_S},
        seconds=SPIN_S,
    )


def test_output_flood_is_dropped(arena: Arena) -> None:
    """What a jail prints is read and forgotten but for its last lines; nobody's memory grows."""
    size = 96 * MIB
    alias = new_alias()
    process = start_control("flood", {"size": size}, alias, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    assert process.stdin is not None
    process.stdin.write(b"\n")
    process.stdin.flush()
    kept = process.stdout.read(size // 2)
    process.kill()
    process.communicate()
    assert len(kept) == size // 2, "the control of the flood failed"
    with arena.environment() as env:
        env.reset()
        ours = [psutil.Process(), *psutil.Process().children()]
        before = [one.memory_info().rss for one in ours]
        run = Run(alias, True)
        call(env, run, "flood", {"size": size})
        after = [one.memory_info().rss for one in ours]
        env.reset()
    grown = max(late - early for late, early in zip(after, before, strict=True))
    assert run.value == size, run.error
    arena.judge("flood the output", "succeeds", grown > 32 * MIB, f"grew by {grown} bytes")


def test_bombs_leave_the_host_usable(arena: Arena) -> None:
    """After a fork bomb and its end nothing of it is left, and the next jail starts."""
    alias = new_alias()
    with arena.environment(limits={"processes": PROCESSES}) as env:
        call(env, Run(alias, True), "fork_bomb", {"count": FORKS})
        assert Run(alias, True).pids()
    assert eventually(lambda: not Run(alias, True).pids())
    with control_run("where_am_i", {}) as run:
        assert run.value["pid"] in run.pids()
    with arena.environment() as env:
        env.reset()

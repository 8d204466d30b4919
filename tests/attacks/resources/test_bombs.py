"""Taking more than the limits give: processes, memory, disk, processor time, output.
The controls are tame: they take a little more than the limits of the jail, and no more."""

import contextlib
import ctypes
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox.errors import WorkerDiedError
from tests.attacks.expectations import NOT_STOPPED
from tests.attacks.harness import (
    USER,
    Arena,
    Run,
    StoppedNowError,
    call,
    control_run,
    new_alias,
    start_control,
)
from tests.attacks.resources.accounts import figure, in_pipes, of_processes, tasks, terminals
from tests.support.interpreter import profiles
from tests.support.processes import eventually, most_grown, resident
from tests.support.turns import LONGEST_S, turn

FAMILY = "Bombs"
MIB = 1 << 20
MEMORY, BOMB = 128 * MIB, 224 * MIB
SMALL, SMALL_BOMB = 72 * MIB, 120 * MIB
"""For the kernel's own objects, which are many and small: each takes a call."""
PROCESSES, FORKS = 32, 80
DISK, FILL = 16 * MIB, 64 * MIB
FILES, INODES = 300, 1500
CPU_S, SPIN_S = 1, 3.0
TERMINALS = 80
"""More than the 64 that a jail may have."""


@pytest.mark.short("strict-fork")
@pytest.mark.parametrize(("title", "payload"), [("fork", "fork_bomb"), ("thread", "thread_bomb")])
def test_fork_bomb_stops_at_the_limit(arena: Arena, title: str, payload: str) -> None:
    arena.attack(
        f"{title} bomb",
        payload,
        lambda run: tasks(run) > PROCESSES,
        limits={"processes": PROCESSES},
        count=FORKS,
    )


def test_pseudo_terminals_stop_at_a_number(arena: Arena) -> None:
    """Each is some memory of the kernel in no account."""
    arena.attack(
        "pseudo terminals", "terminals", lambda run: terminals(run) > TERMINALS, count=2 * TERMINALS
    )


def stays(run: Run, over: Callable[[Run], bool], within_s: float = 10.0) -> bool:
    """Whether a run stays over a limit: what is only measured is noticed a moment later."""
    return over(run) and not (run.inside and eventually(lambda: not over(run), within_s))


def of_the_machine(name: str) -> Callable[[Run], int]:
    """By how much a figure of the whole machine has grown since now, while a run is there."""
    before = settled(name)
    return lambda run: figure("/proc/meminfo", name) - before if run.pids() else 0


def settled(name: str) -> int:
    """A figure that no longer falls: the kernel frees what an earlier run held a while after it."""
    for _ in range(60):
        before = figure("/proc/meminfo", name)
        time.sleep(0.5)
        now = figure("/proc/meminfo", name)
        if now > before - 2 * MIB:
            break
    return now


SHARED = "Shmem"
KERNEL = "SUnreclaim"
"""Memory of the kernel's own objects."""

# Each is judged by the kernel's account that shows it: of the run's processes, where one of
# theirs does, else of the machine, since then it belongs to no process.
KINDS: dict[str, str | Callable[[Run], int]] = {
    **dict.fromkeys(
        ("heap", "children", "copies of a file's pages"), lambda run: of_processes(run, "Pss")
    ),
    "page tables": lambda run: of_processes(run, "VmPTE", "status"),
    "pipes": in_pipes,
    **dict.fromkeys(
        ("shared", "shared, in small pieces", "shared, out of the page tables"), SHARED
    ),
    **dict.fromkeys(("shared, unmapped but for a page", "memfd", "memfd in flight"), SHARED),
    **dict.fromkeys(("memfd without a descriptor", "System V"), SHARED),
    **dict.fromkeys(("mappings", "semaphores", "messages", "sockets", "sockets in flight"), KERNEL),
    **dict.fromkeys(("epoll watches", "file locks", "empty folders"), KERNEL),
    **dict.fromkeys(("attributes of files", "access lists"), KERNEL),
}


WITHOUT_NAMESPACES = {
    *("heap", "shared", "System V", "semaphores", "sockets", "sockets in flight"),
    *("empty folders", "attributes of files", "access lists"),
}
"""What ``no-userns`` counts or bounds in another way, without namespaces of networks, System V's
objects (of which messages stand in the filter's list beside semaphores) and mounts. The rest is in
the same account as under ``strict``, where all are tried.
"""
BOMBS = [
    pytest.param(*profile.values, kind, marks=profile.marks)
    for profile in profiles("strict", "no-userns")
    for kind in KINDS
    if profile.values == ("strict",) or kind in WITHOUT_NAMESPACES
]


@pytest.fixture
def _machine() -> Iterator[None]:
    """The machine's account belongs to one bomb at a time, whichever process tests it."""
    with turn("memory"):
        yield


@pytest.mark.short("strict-heap")
@pytest.mark.timeout(LONGEST_S + 300)
@pytest.mark.usefixtures("_machine")
@pytest.mark.parametrize(("arena", "kind"), BOMBS, indirect=["arena"])
def test_memory_bomb_stops_at_the_limit(arena: Arena, kind: str) -> None:
    """All memory counts: private, shared, without a name or an owner, of all processes together."""
    no_pipes = "the kernel limits a plain user's pipes by itself"
    measure = KINDS[kind]
    most, size = (SMALL, SMALL_BOMB) if measure is KERNEL else (MEMORY, BOMB)
    grown: list[Callable[[Run], int]] = []
    left: list[Run] = []

    def begin() -> None:
        grown[:] = [of_the_machine(measure) if isinstance(measure, str) else measure]

    def over(run: Run) -> bool:
        left.append(run)
        # what nothing stops is not waited for as long
        anywhere = {"strict", "no-userns"} <= {*NOT_STOPPED.get(f"memory bomb: {kind}", ())}
        within_s = 1.0 if anywhere else 10.0
        return stays(run, lambda run: grown[0](run) > most + 16 * MIB, within_s)

    def attack() -> None:
        arena.attack(
            f"memory bomb: {kind}",
            "memory_bomb",
            over,
            before=begin,
            limits={
                "memory_bytes": most,
                "processes": 128,
                "open_files": 65536,
                "disk_files": 1_000_000,
            },
            impossible=no_pipes if kind == "pipes" and USER == "user" else "",
            kind=kind,
            size=size,
        )

    try:
        # the machine's account falls by what others free meanwhile: who was not seen growing is
        # looked at again
        for _ in range(2):
            with contextlib.suppress(StoppedNowError):
                return attack()
            del arena.rows[-1:]
        attack()
    finally:
        for run in left:
            if not run.inside and isinstance(run.value, list):
                remove(kind, run.value)


def remove(kind: str, left: list[Any]) -> None:
    """End what outlives a control: System V objects, and folders."""
    libc = ctypes.CDLL(None)
    for number in left:
        if isinstance(number, str):
            shutil.rmtree(number)
        elif kind == "messages":
            libc.msgctl(number, 0, None)
        else:
            libc.semctl(number, 0, 0)


def test_memory_bomb_does_not_hurt_the_neighbours(arena: Arena) -> None:
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
    folders = [home / name for name in ("one", "two")]
    for folder in folders:
        folder.mkdir()
    return [str(folder) for folder in folders]


def left_by(run: Run, measure: Callable[[str], int]) -> int:
    """What a run has left in its folders, as it sees them, added up."""
    [pid, *_] = run.pids() or [0]
    root = f"/proc/{pid}/root" if run.inside else ""
    count = 0
    for path, *_ in (run.value or {}).values():
        with contextlib.suppress(OSError):
            count += measure(f"{root}{path}") if path else 0
    return count


@pytest.mark.short("strict")
@pytest.mark.parametrize(
    ("title", "payload", "limits", "most", "much", "measure"),
    [
        (
            "fill the disk",
            "fill_disk",
            {"disk_bytes": DISK, "memory_bytes": 1024 * MIB},
            2 * DISK,
            {"size": FILL},
            lambda path: os.stat(path).st_blocks * 512,
        ),
        (
            "use up the inodes",
            "fill_inodes",
            {"disk_files": FILES},
            2 * FILES,
            {"count": INODES},
            lambda path: len(os.listdir(path)),
        ),
    ],
    ids=["bytes", "inodes"],
)
def test_disk_cannot_be_filled(
    arena: Arena,
    places: list[str],
    title: str,
    payload: str,
    limits: dict[str, int],
    most: int,
    much: dict[str, int],
    measure: Callable[[str], int],
) -> None:
    """All that a jail writes, in whatever folders, and empty files too, stay below its limits."""
    arena.attack(
        title,
        payload,
        lambda run: stays(run, lambda run: left_by(run, measure) > most),
        limits=limits,
        inside={"folders": []},
        folders=places,
        **much,
    )


def test_processor_time_runs_out(strict: Arena) -> None:
    strict.attack(
        "burn processor time",
        "spin",
        lambda run: sum(spent(pid) for pid in run.pids()) > (CPU_S + SPIN_S) / 2,
        limits={"cpu_time_s": CPU_S},
        seconds=SPIN_S,
    )


def spent(pid: int) -> float:
    with contextlib.suppress(psutil.NoSuchProcess):
        times = psutil.Process(pid).cpu_times()
        return float(times.user + times.system)
    return 0.0


def test_output_flood_is_dropped(arena: Arena) -> None:
    """What a jail prints is read and forgotten but for its last lines; nobody's memory grows."""
    size = 96 * MIB
    alias = new_alias()
    process = start_control("flood", {"size": size}, alias, stderr=subprocess.DEVNULL)
    process.stdin.write(b"\n")
    process.stdin.flush()
    kept = process.stdout.read(size // 2)
    process.kill()
    process.communicate()
    assert len(kept) == size // 2, "the control of the flood failed"
    with arena.environment() as env:
        env.reset()
        before = resident()
        run = Run(alias, True)
        call(env, run, "flood", {"size": size})
        grown = most_grown(before)
        env.reset()
    assert run.value == size, run.error
    arena.judge("flood the output", "succeeds", grown > 32 * MIB, f"grew by {grown} bytes")


def test_bombs_leave_the_host_usable(arena: Arena) -> None:
    alias = new_alias()
    with arena.environment(limits={"processes": PROCESSES}) as env:
        call(env, Run(alias, True), "fork_bomb", {"count": FORKS})
        assert Run(alias, True).pids()
    assert eventually(lambda: not Run(alias, True).pids())
    with control_run("where_am_i", {}) as run:
        assert run.value["pid"] in run.pids()
    with arena.environment() as env:
        env.reset()

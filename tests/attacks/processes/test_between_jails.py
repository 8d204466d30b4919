"""One jail against another one of the same server, of the same caller, while both are live.

The control aims the same payload at an ordinary process of the caller's.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.attacks.harness import Arena, new_alias, run_in, token
from tests.attacks.processes.neighbour import Pair, between
from tests.attacks.processes.victim import READS, SIGNALS, WORD
from tests.support.interpreter import can_run
from tests.support.processes import may_change_niceness, other_niceness

FAMILY = "Other jails"


@pytest.fixture
def pair(arena: Arena) -> Iterator[Pair]:
    """A process of the caller's and another jail."""
    with between(arena) as made:
        yield made


@pytest.mark.parametrize("title", READS)
def test_memory_and_files_of_another_jail_cannot_be_read(
    arena: Arena, pair: Pair, title: str
) -> None:
    """Nothing that one jail keeps to itself comes back from another one."""
    payload, names = READS[title]
    arena.steal(f"read another jail: {title}", payload, pair.secret, **pair.at(*names))


def test_another_jail_cannot_be_written_to(arena: Arena, pair: Pair) -> None:
    """No debugger attaches across."""
    at = pair.at("pid", "address")
    arena.attack("write another jail: ptrace", "ptrace_poke", pair.written, word=WORD, **at)


def test_scratch_of_another_jail_cannot_be_read(arena: Arena, pair: Pair) -> None:
    """By the other jail's own path, and through its root: neither leads there."""
    path = pair.inside.path  # type: ignore[union-attr]
    through_root = f"/proc/{pair.inside.pid}/root{path}"
    own = f"/proc/{pair.outside.pid}/fd/{pair.outside.fd}"
    for way, inside in {"path": path, "/proc/<pid>/root": through_root}.items():
        assert pair.secret in Path(through_root).read_text()
        title = f"read another jail's scratch: {way}"
        arena.steal(title, "read_file", pair.secret, inside={"path": inside}, path=own)


@pytest.mark.parametrize("way", SIGNALS)
def test_signals_do_not_reach_another_jail(arena: Arena, pair: Pair, way: str) -> None:
    """Sent in any of the ways there are."""
    pair.signal(arena, f"signal another jail: {way}", way=way, **pair.at("pid"))


@pytest.mark.usefixtures("broadcasting")
def test_everybody_is_not_another_jail(arena: Arena, pair: Pair) -> None:
    """kill(-1) does not reach a neighbour either."""
    pair.signal(arena, "signal another jail: kill(-1)", "signal_all", "broadcasts")


def test_limits_and_priority_of_another_jail_stay(arena: Arena, pair: Pair) -> None:
    """prlimit and setpriority are refused."""
    nice = other_niceness()
    lowest = "" if may_change_niceness() else "this run has the lowest priority already"
    arena.attack(
        "change another jail: prlimit",
        "prlimit",
        lambda run: open_files(pair.of(run).pid) == 7,
        files=7,
        **pair.at("pid"),
    )
    arena.attack(
        "change another jail: setpriority",
        "setpriority",
        lambda run: os.getpriority(os.PRIO_PROCESS, pair.of(run).pid) == nice,
        impossible=lowest,
        nice=nice,
        **pair.at("pid"),
    )


def open_files(pid: int) -> int:
    """A process's soft limit."""
    for line in Path(f"/proc/{pid}/limits").read_text().splitlines():
        if line.startswith("Max open files"):
            return int(line.split()[3])
    raise AssertionError("/proc says nothing of open files")


@pytest.mark.parametrize(
    ("arena", "shared"),
    [("strict", False), *([("container", True)] if can_run("container") else [])],
    indirect=["arena"],
)
def test_shared_memory_of_another_jail(arena: Arena, shared: bool) -> None:
    """A container has one /dev/shm for all of its jails, as the threat model says of it."""
    secret, path = token(), Path(f"/dev/shm/envhub-{new_alias()}")
    try:
        with arena.environment() as other, arena.environment() as env:
            wrote = run_in(other, "create_file", path=str(path), text=secret)
            assert secret in run_in(other, "read_file", path=str(path)).text, wrote.text
            read = run_in(env, "read_file", path=str(path))
            assert (read.value == secret) == shared, read.text
    finally:
        path.unlink(missing_ok=True)

"""One jail against another one of the same server, of the same caller, while both are live.
The control aims the same payload at an ordinary process of the caller's."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.attacks.harness import Arena, LastingJail, OpenJail, new_alias, run_in, token
from tests.attacks.processes.neighbour import Neighbour, Pair, neighbour
from tests.attacks.processes.victim import READS, SIGNALS, WORD, victim
from tests.support.interpreter import can_run
from tests.support.processes import may_change_niceness, other_niceness

FAMILY = "Other jails"


@pytest.fixture(scope="module")
def other(lasting: LastingJail) -> Iterator[Neighbour]:
    with neighbour(Arena(lasting.profile, FAMILY), token()) as made:
        yield made


@pytest.fixture
def pair(other: Neighbour) -> Iterator[Pair]:
    with victim(other.secret) as outside:
        yield Pair(outside, other)


@pytest.mark.parametrize("title", READS)
def test_memory_and_files_of_another_jail_are_closed(
    jail: OpenJail, pair: Pair, title: str
) -> None:
    payload, names = READS[title]
    jail.steal(f"read another jail: {title}", payload, pair.secret, **pair.at(*names))


def test_another_jail_cannot_be_written_to(jail: OpenJail, pair: Pair) -> None:
    at = pair.at("pid", "address")
    jail.attack("write another jail: ptrace", "ptrace_poke", pair.written, word=WORD, **at)


def test_scratch_of_another_jail_cannot_be_read(jail: OpenJail, pair: Pair) -> None:
    path = pair.inside.path
    through_root = f"/proc/{pair.inside.pid}/root{path}"
    own = f"/proc/{pair.outside.pid}/fd/{pair.outside.fd}"
    for way, inside in {"path": path, "/proc/<pid>/root": through_root}.items():
        assert pair.secret in Path(through_root).read_text()
        title = f"read another jail's scratch: {way}"
        jail.steal(title, "read_file", pair.secret, inside={"path": inside}, path=own)


@pytest.mark.parametrize("way", SIGNALS)
def test_signals_do_not_reach_another_jail(jail: OpenJail, pair: Pair, way: str) -> None:
    pair.signal(jail, f"signal another jail: {way}", way=way, **pair.at("pid"))


@pytest.mark.usefixtures("broadcasting")
def test_everybody_is_not_another_jail(jail: OpenJail, pair: Pair) -> None:
    pair.signal(jail, "signal another jail: kill(-1)", "signal_all", "broadcasts")


def test_limits_and_priority_of_another_jail_stay(jail: OpenJail, pair: Pair) -> None:
    nice = other_niceness()
    lowest = "" if may_change_niceness() else "this run has the lowest priority already"
    jail.attack(
        "change another jail: prlimit",
        "prlimit",
        lambda run: open_files(pair.of(run).pid) == 7,
        files=7,
        **pair.at("pid"),
    )
    jail.attack(
        "change another jail: setpriority",
        "setpriority",
        lambda run: os.getpriority(os.PRIO_PROCESS, pair.of(run).pid) == nice,
        impossible=lowest,
        nice=nice,
        **pair.at("pid"),
    )


def open_files(pid: int) -> int:
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

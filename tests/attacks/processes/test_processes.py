"""Doing something to the client's processes: reading, writing, signalling, slowing them."""

import ctypes
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.attacks.harness import OpenJail
from tests.attacks.processes.neighbour import Pair, victims
from tests.attacks.processes.victim import SIGNALS, WORD
from tests.support.processes import may_change_niceness, other_niceness

FAMILY = "Other processes"
_IDLE_CLASS = 3 << 13
_ONE_CORE = {min(os.sched_getaffinity(0))}
_NICE = other_niceness()
_LOWEST = "" if may_change_niceness() else "this run has the lowest priority already"
_SINGLE = "" if len(os.sched_getaffinity(0)) > 1 else "this machine has a single core"


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    """Two processes of the caller's, whose memory nobody writes."""
    with victims() as made:
        yield made


@pytest.mark.parametrize(
    ("title", "payload", "arguments"),
    [
        ("ptrace the client", "ptrace_poke", {"word": WORD}),
        ("process_vm_writev into the client", "process_vm_write", {"message": "attacked"}),
        ("write /proc/<client>/mem", "proc_mem_write", {"message": "attacked"}),
    ],
)
def test_memory_cannot_be_written(
    jail: OpenJail, title: str, payload: str, arguments: dict[str, Any]
) -> None:
    with victims() as pair:
        jail.attack(title, payload, pair.written, **pair.at("pid", "address"), **arguments)


@pytest.mark.short("strict-read /proc")
@pytest.mark.parametrize(
    ("title", "payload", "names"),
    [
        ("process_vm_readv from the client", "process_vm_read", ("address", "size")),
        ("read /proc/<client>/mem", "proc_mem_read", ("address", "size")),
        ("read what the client has open (/proc/<client>/fd)", "proc_fd", ("fd",)),
        ("take a descriptor of the client (pidfd_getfd)", "pidfd_getfd", ("fd",)),
    ],
)
def test_memory_and_files_cannot_be_read(
    jail: OpenJail, pair: Pair, title: str, payload: str, names: tuple[str, ...]
) -> None:
    jail.steal(title, payload, pair.secret, **pair.at("pid", *names))


def test_maps_cannot_be_read(jail: OpenJail, pair: Pair) -> None:
    """Where the client's libraries lie is not told: that would help other attacks."""
    firsts = {
        one.pid: Path(f"/proc/{one.pid}/maps").read_text().split()[0]
        for one in (pair.outside, pair.inside)
    }
    jail.attack(
        "read /proc/<client>/maps",
        "proc_maps",
        lambda run: firsts[pair.of(run).pid] in run.text,
        **pair.at("pid"),
    )


@pytest.mark.usefixtures("broadcasting")
def test_broadcast_signals_do_not_reach_the_client(jail: OpenJail, pair: Pair) -> None:
    pair.signal(jail, "signal everybody: kill(-1)", "signal_all", "broadcasts")


@pytest.mark.short("strict-kill")
@pytest.mark.parametrize("way", SIGNALS)
def test_signals_do_not_reach_the_client(jail: OpenJail, pair: Pair, way: str) -> None:
    pair.signal(jail, f"signal the client: {way}", way=way, **pair.at("pid"))


def io_priority(pid: int) -> int:
    numbers = (252, 31)
    libc = ctypes.CDLL(None, use_errno=True)
    return int(libc.syscall(numbers[os.uname().machine == "aarch64"], 1, pid))


Look = Callable[[int], object]
CHANGES: dict[str, tuple[str, dict[str, Any], Look]] = {
    "prlimit on the client": (
        "prlimit",
        {"files": 7},
        lambda pid: resource.prlimit(pid, resource.RLIMIT_NOFILE)[0] == 7,
    ),
    "setpriority on the client": (
        "setpriority",
        {"nice": _NICE, "impossible": _LOWEST},
        lambda pid: os.getpriority(os.PRIO_PROCESS, pid) == _NICE,
    ),
    "sched_setaffinity on the client": (
        "sched_setaffinity",
        {"cpus": list(_ONE_CORE), "impossible": _SINGLE},
        lambda pid: os.sched_getaffinity(pid) == _ONE_CORE,
    ),
    "sched_setscheduler on the client": (
        "sched_setscheduler",
        {},
        lambda pid: os.sched_getscheduler(pid) == os.SCHED_IDLE,
    ),
    "ioprio_set on the client": (
        "ioprio_set",
        {"priority": _IDLE_CLASS},
        lambda pid: io_priority(pid) == _IDLE_CLASS,
    ),
    # the score that the kernel picks by whom it ends for want of memory
    "write /proc/<client>/oom_score_adj": (
        "oom_score",
        {"score": 777},
        lambda pid: Path(f"/proc/{pid}/oom_score_adj").read_text().strip() == "777",
    ),
}


@pytest.mark.parametrize("title", CHANGES)
def test_limits_and_priorities_cannot_be_changed(jail: OpenJail, pair: Pair, title: str) -> None:
    payload, arguments, changed = CHANGES[title]
    aimed = {**pair.at("pid"), **arguments}
    jail.attack(title, payload, lambda run: changed(pair.of(run).pid), **aimed)

"""Doing something to the client's processes: reading, writing, signalling, slowing them."""

from __future__ import annotations

import ctypes
import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.attacks.harness import Arena, Run, token
from tests.attacks.hostile.payloads import kernel
from tests.attacks.victim import Victim, victim
from tests.support.processes import eventually

FAMILY = "Other processes"

_IDLE_CLASS = 3 << 13


def test_memory_cannot_be_written_as_a_debugger(arena: Arena) -> None:
    """ptrace does not attach."""
    with victim(token()) as target:
        word = int.from_bytes(b"attacked", "little")
        arena.attack(
            "ptrace the client",
            "ptrace_poke",
            lambda run: "attacked" in target.state()["text"],
            before=lambda: restore(target),
            pid=target.pid,
            address=target.address,
            word=word,
        )


def restore(target: Victim) -> None:
    """Put other bytes into the victim's memory, from here."""
    with open(f"/proc/{target.pid}/mem", "r+b", 0) as memory:
        os.pwrite(memory.fileno(), b"-" * 8, target.address)
    assert "attacked" not in target.state()["text"]


@pytest.mark.parametrize(
    ("title", "payload"),
    [
        ("process_vm_writev into the client", "process_vm_write"),
        ("write /proc/<client>/mem", "proc_mem_write"),
    ],
)
def test_memory_cannot_be_written(arena: Arena, title: str, payload: str) -> None:
    """Nor by the two ways that need no debugger."""
    with victim(token()) as target:
        arena.attack(
            title,
            payload,
            lambda run: "attacked" in target.state()["text"],
            before=lambda: restore(target),
            pid=target.pid,
            address=target.address,
            message="attacked",
        )


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
    arena: Arena, title: str, payload: str, names: tuple[str, ...]
) -> None:
    """Nothing that another process keeps to itself comes back."""
    secret = token()
    with victim(secret) as target:
        arguments = {name: getattr(target, name) for name in names}
        arena.attack(title, payload, lambda run: secret in run.text, pid=target.pid, **arguments)


def test_maps_cannot_be_read(arena: Arena) -> None:
    """Where the client's libraries lie is not told: that would help other attacks."""
    with victim(token()) as target:
        lines = Path(f"/proc/{target.pid}/maps").read_text().splitlines()
        arena.attack(
            "read /proc/<client>/maps",
            "proc_maps",
            lambda run: lines[0].split()[0] in run.text,
            pid=target.pid,
        )


@pytest.mark.usefixtures("broadcasting")
def test_broadcast_signals_do_not_reach_the_client(arena: Arena) -> None:
    """kill(-1) ends at the jail's wall."""
    with victim(token()) as target:
        reach = signalled(target, "broadcasts")
        arena.attack("signal everybody: kill(-1)", "signal_all", reach)


@pytest.mark.short("strict-kill")
@pytest.mark.parametrize("way", ["kill", "sigqueue", "pidfd", "F_SETOWN"])
def test_signals_do_not_reach_the_client(arena: Arena, way: str) -> None:
    """Nor does one that is meant for it, sent in any of the ways there are."""
    with victim(token()) as target:
        arena.attack(
            f"signal the client: {way}",
            "signal_one",
            signalled(target),
            pid=target.pid,
            way=way,
        )


def signalled(target: Victim, kind: str = "signals") -> Callable[[Run], bool]:
    """Whether the victim has counted another signal since this was asked last."""
    seen = 0

    def more(run: Run) -> bool:
        nonlocal seen
        deadline = 0.3 if run.inside else 60.0
        came = eventually(lambda: target.state()[kind] > seen, deadline)
        seen = target.state()[kind]
        return came

    return more


def test_limits_of_the_client_cannot_be_changed(arena: Arena) -> None:
    """prlimit on another process of the same user is refused."""
    with victim(token()) as target:
        normal = resource.prlimit(target.pid, resource.RLIMIT_NOFILE)

        def lowered(run: Run) -> bool:
            return resource.prlimit(target.pid, resource.RLIMIT_NOFILE)[0] == 7

        def undo() -> None:
            resource.prlimit(target.pid, resource.RLIMIT_NOFILE, (normal[0], normal[1]))

        arena.attack(
            "prlimit on the client", "prlimit", lowered, before=undo, pid=target.pid, files=7
        )


def test_priority_of_the_client_cannot_be_changed(arena: Arena) -> None:
    """setpriority is refused; a higher nice value cannot be taken back without root."""
    with victim(token()) as target, victim(token()) as other:

        def slower(run: Run) -> bool:
            return os.getpriority(os.PRIO_PROCESS, (other if run.inside else target).pid) == 19

        arena.attack(
            "setpriority on the client",
            "setpriority",
            slower,
            inside={"pid": other.pid},
            pid=target.pid,
            nice=19,
        )


def test_affinity_of_the_client_cannot_be_changed(arena: Arena) -> None:
    """sched_setaffinity is refused, or does nothing."""
    cpus = os.sched_getaffinity(0)
    one = {min(cpus)}
    with victim(token()) as target:
        arena.attack(
            "sched_setaffinity on the client",
            "sched_setaffinity",
            lambda run: os.sched_getaffinity(target.pid) == one,
            before=lambda: os.sched_setaffinity(target.pid, cpus),
            pid=target.pid,
            cpus=list(one),
            impossible="" if len(cpus) > 1 else "this machine has a single core",
        )


def test_scheduling_of_the_client_cannot_be_changed(arena: Arena) -> None:
    """sched_setscheduler is refused, or does nothing."""
    with victim(token()) as target, victim(token()) as other:

        def idle(run: Run) -> bool:
            pid = other.pid if run.inside else target.pid
            return os.sched_getscheduler(pid) == os.SCHED_IDLE

        arena.attack(
            "sched_setscheduler on the client",
            "sched_setscheduler",
            idle,
            inside={"pid": other.pid},
            pid=target.pid,
        )


def test_disk_priority_of_the_client_cannot_be_changed(arena: Arena) -> None:
    """ioprio_set is refused."""
    with victim(token()) as target:

        def idle(run: Run) -> bool:
            return io_priority(target.pid) == _IDLE_CLASS

        arena.attack(
            "ioprio_set on the client",
            "ioprio_set",
            idle,
            before=lambda: kernel.syscall("ioprio_set", 1, target.pid, 0),
            pid=target.pid,
            priority=_IDLE_CLASS,
        )


def io_priority(pid: int) -> int:
    """``ioprio_get``."""
    numbers = (252, 31)
    libc = ctypes.CDLL(None, use_errno=True)
    return int(libc.syscall(numbers[os.uname().machine == "aarch64"], 1, pid))


def test_client_cannot_be_made_the_first_to_die(arena: Arena) -> None:
    """The score that the kernel picks its victim by cannot be written."""
    with victim(token()) as target, victim(token()) as other:

        def chosen(run: Run) -> bool:
            pid = other.pid if run.inside else target.pid
            return Path(f"/proc/{pid}/oom_score_adj").read_text().strip() == "777"

        arena.attack(
            "write /proc/<client>/oom_score_adj",
            "oom_score",
            chosen,
            inside={"pid": other.pid},
            pid=target.pid,
            score=777,
        )

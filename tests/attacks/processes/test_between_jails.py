"""One jail against another one of the same server, of the same caller, while both are live.

The control aims the same payload at an ordinary process of the caller's.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.attacks.harness import Arena, Run, call, new_alias, token
from tests.attacks.processes.neighbour import Neighbour, neighbour
from tests.attacks.processes.victim import Victim, victim
from tests.support.interpreter import can_run
from tests.support.processes import eventually

FAMILY = "Other jails"


@pytest.mark.parametrize(
    ("title", "payload", "names"),
    [
        ("process_vm_readv", "process_vm_read", ("address", "size")),
        ("/proc/<pid>/mem", "proc_mem_read", ("address", "size")),
        ("/proc/<pid>/fd", "proc_fd", ("fd",)),
        ("pidfd_getfd", "pidfd_getfd", ("fd",)),
    ],
)
def test_memory_and_files_of_another_jail_cannot_be_read(
    arena: Arena, title: str, payload: str, names: tuple[str, ...]
) -> None:
    """Nothing that one jail keeps to itself comes back from another one."""
    secret = token()
    with victim(secret) as target, neighbour(arena, secret) as other:
        arena.attack(
            f"read another jail: {title}",
            payload,
            lambda run: secret in run.text,
            inside={"pid": other.pid, **{name: getattr(other, name) for name in names}},
            pid=target.pid,
            **{name: getattr(target, name) for name in names},
        )


def test_another_jail_cannot_be_written_to(arena: Arena) -> None:
    """No debugger attaches across."""
    word = int.from_bytes(b"attacked", "little")
    with victim(token()) as target, neighbour(arena, token()) as other:
        arena.attack(
            "write another jail: ptrace",
            "ptrace_poke",
            lambda run: "attacked" in (other if run.inside else target).state()["text"],
            inside={"pid": other.pid, "address": other.address},
            pid=target.pid,
            address=target.address,
            word=word,
        )


def test_scratch_of_another_jail_cannot_be_read(arena: Arena) -> None:
    """By the other jail's own path, and through its root: neither leads there."""
    secret = token()
    with victim(secret) as target, neighbour(arena, secret) as other:
        for way, path in {
            "path": other.path,
            "/proc/<pid>/root": f"/proc/{other.pid}/root{other.path}",
        }.items():
            assert secret in Path(f"/proc/{other.pid}/root{other.path}").read_text()
            arena.attack(
                f"read another jail's scratch: {way}",
                "read_file",
                lambda run: secret in run.text,
                inside={"path": path},
                path=f"/proc/{target.pid}/fd/{target.fd}",
            )


@pytest.mark.parametrize("way", ["kill", "sigqueue", "pidfd", "F_SETOWN"])
def test_signals_do_not_reach_another_jail(arena: Arena, way: str) -> None:
    """Sent in any of the ways there are."""

    def came(of: Victim | Neighbour, patience_s: float) -> bool:
        return eventually(lambda: of.state()["signals"] > 0, patience_s)

    with victim(token()) as target, neighbour(arena, token()) as other:
        arena.attack(
            f"signal another jail: {way}",
            "signal_one",
            lambda run: came(other, 0.5) if run.inside else came(target, 60.0),
            inside={"pid": other.pid},
            pid=target.pid,
            way=way,
        )


@pytest.mark.usefixtures("broadcasting")
def test_everybody_is_not_another_jail(arena: Arena) -> None:
    """kill(-1) does not reach a neighbour either."""
    with victim(token()) as target, neighbour(arena, token()) as other:
        seen = [0]

        def came(run: Run) -> bool:
            of = other if run.inside else target
            return eventually(
                lambda: of.state()["broadcasts"] > seen[0], 0.5 if run.inside else 60.0
            )

        def begin() -> None:  # the control is the caller's own, and reaches all that is theirs
            seen[0] = other.state()["broadcasts"]

        arena.attack("signal another jail: kill(-1)", "signal_all", came, before=begin)


def open_files(pid: int) -> int:
    """A process's soft limit."""
    for line in Path(f"/proc/{pid}/limits").read_text().splitlines():
        if line.startswith("Max open files"):
            return int(line.split()[3])
    raise AssertionError("/proc says nothing of open files")


def test_limits_and_priority_of_another_jail_stay(arena: Arena) -> None:
    """prlimit and setpriority are refused."""
    with victim(token()) as target, neighbour(arena, token()) as other:

        def pid(run: Run) -> int:
            return other.pid if run.inside else target.pid

        arena.attack(
            "change another jail: prlimit",
            "prlimit",
            lambda run: open_files(pid(run)) == 7,
            inside={"pid": other.pid},
            pid=target.pid,
            files=7,
        )
        arena.attack(
            "change another jail: setpriority",
            "setpriority",
            lambda run: os.getpriority(os.PRIO_PROCESS, pid(run)) == 19,
            inside={"pid": other.pid},
            pid=target.pid,
            nice=19,
        )


@pytest.mark.parametrize(
    ("arena", "shared"),
    [("strict", False), *([("container", True)] if can_run("container") else [])],
    indirect=["arena"],
)
def test_shared_memory_of_another_jail(arena: Arena, shared: bool) -> None:
    """A container has one /dev/shm for all of its jails, as the threat model says of it."""
    secret, path = token(), Path(f"/dev/shm/envhub-{new_alias()}")
    wrote, read = Run(new_alias(), True), Run(new_alias(), True)
    try:
        with arena.environment() as other, arena.environment() as env:
            call(other, wrote, "create_file", {"path": str(path), "text": secret})
            call(other, read, "read_file", {"path": str(path)})
            assert secret in read.text, wrote.text
            read = Run(new_alias(), True)
            call(env, read, "read_file", {"path": str(path)})
            assert (read.value == secret) == shared, read.text
    finally:
        path.unlink(missing_ok=True)

"""What clients may ask of a server's jails: each bound, with jails that run nothing."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement, Limits
from envhub_worker.protocol.limits import DEFAULT_LIMITS, MAX_IN_FLIGHT
from envhub_worker.protocol.shared_memory import words
from envhub_worker.supervisor import jails
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker, RefusedError, Witness, whole_jail

MINE, THEIRS = Asker(b"one", 1, b"mine"), Asker(b"two", 1, b"theirs")
SLABS = (0, words.HEADER_BYTES + words.INFO_BYTES, 64)
MOST = 8
"""Runners of a jail, in the test of that bound."""


class _Jail:
    """One whose runners come up, and say nothing."""

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.output, self._writes = os.pipe()
        os.set_blocking(self.output, False)
        self.others: list[socket.socket] = []
        self.control = socket.socket()

    def fileno(self) -> int:
        return self.control.fileno()

    def poll(self) -> list[Any]:
        return []

    def start_runner(self) -> tuple[int, socket.socket]:
        ours, theirs = socket.socketpair()
        self.others.append(theirs)
        return len(self.others), ours

    def kill_runner(self, runner: int) -> None:
        pass

    def kill(self) -> None:
        pass


class _Spawner:
    """A zygote; all that live are in ``alive``."""

    alive: list[_Spawner]

    def __init__(self, *_: Any, **__: Any) -> None:
        self._socket = socket.socket()
        self.alive.append(self)

    def fileno(self) -> int:
        return self._socket.fileno()

    def spawn(self, spec: Any) -> _Jail:
        return _Jail(spec)

    def close(self) -> None:
        self.alive.remove(self)


def served(folder: Path, *, local: bool) -> Jails:
    loop, witness = Loop(Witness().failed), Witness()
    folder.mkdir()
    return Jails(loop, lambda *_: None, folder, (), folder / "fds", None, witness, local=local)


@pytest.fixture(autouse=True)
def _nothing_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket has 107 bytes at most
    _Spawner.alive = []
    monkeypatch.setattr(jails, "Spawner", _Spawner)


@pytest.fixture
def ours() -> Iterator[Jails]:
    found = served(Path("ours"), local=True)
    yield found
    found.close()


def opened(of: Jails, runners: int = 1, **policy: Any) -> Any:
    confinement = asdict(Confinement(**policy))
    of.open(MINE, m.OpenJail("x", "", "", "/snapshot", "env.py", confinement, runners))
    return of.open_ones()[-1]


def relay(of: Jails, entry: Any, *parts: Any, frames: int = 1, **how: Any) -> None:
    of.relay(MINE, m.Relay(entry.number, "step", parts, **how), [b"x"] * frames)


def test_jails_and_their_runners_are_bounded(ours: Jails, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of a local client: each is a process, and memory of the server."""
    monkeypatch.setattr(jails, "MAX_JAILS", 2)
    monkeypatch.setattr(jails, "MAX_RUNNERS", MOST)
    for runners in (0, MOST + 1):
        with pytest.raises(RefusedError, match="may have 1 to"):
            opened(ours, runners)
    entry = opened(ours, MOST - 1)
    for runners in (0, 2):
        with pytest.raises(RefusedError, match="num_workers"):
            ours.start_more(MINE, m.StartRunners(entry.number, runners))
    ours.start_more(MINE, m.StartRunners(entry.number, 1))
    opened(ours)
    with pytest.raises(RefusedError, match="at most 2 jails"):
        opened(ours)


def test_a_jail_without_its_runner_ends(ours: Jails, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the cause for its client; else the others would live on, and nobody hear of them."""
    start = _Jail.start_runner

    def refuse(jail: _Jail) -> tuple[int, socket.socket]:
        if jail.others:
            raise OSError("Too many references")
        return start(jail)

    monkeypatch.setattr(_Jail, "start_runner", refuse)
    with pytest.raises(OSError, match="Too many references"):
        opened(ours, 2)
    assert ours.open_ones() == []


@pytest.mark.parametrize(
    ("parts", "frames"),
    [
        *(((), 0), ((), 1), (((1, 1),), 2), (((1, 2),), 1), (((1, 0), (2, 1)), 1)),
        *((((1, -1), (2, 2)), 1), (((1, 1), (1, 1)), 2), (((3, 1),), 1)),
        *(((1,), 1), (((True, 1),), 1), (((1, 1, 1),), 1)),
    ],
)
def test_a_relay_adds_up(ours: Jails, parts: tuple[Any, ...], frames: int) -> None:
    """Each frame is for one runner of the jail; else nothing of it is sent."""
    entry = opened(ours, 2)
    with pytest.raises(RefusedError, match="do not fit"):
        relay(ours, entry, *parts, frames=frames)
    assert not any(link.owed for link in entry.links.values())


def test_a_runner_owes_few_answers(ours: Jails) -> None:
    """One that never answers takes no more of the server's memory."""
    entry = opened(ours)
    for _ in range(MAX_IN_FLIGHT):
        relay(ours, entry, (1, 1))
    with pytest.raises(RefusedError, match="answers already"):
        relay(ours, entry, (1, 1))


def test_a_step_needs_slabs_and_no_other_step(ours: Jails) -> None:
    entry = opened(ours)
    step = m.Relay(entry.number, "step", ((1, 1),), stepped=True)
    frame = bytes((words.DTYPES - words.SPIN) * 8)
    for makes, payload in ((False, frame), (True, b"short"), (False, bytes(1 << 20))):
        if makes:
            ours.share(MINE, m.ShareSlabs(entry.number, ((1, *SLABS),)))
        with pytest.raises(RefusedError, match="has no slabs, or owes"):
            ours.relay(MINE, step, [payload])
    ours.relay(MINE, step, [frame])
    with pytest.raises(RefusedError, match="has no slabs, or owes"):
        ours.relay(MINE, step, [frame])
    with pytest.raises(RefusedError, match="owes an answer"):  # that would be lost with its slabs
        ours.share(MINE, m.ShareSlabs(entry.number, ((1, *SLABS),)))


def test_slabs_have_sizes_that_are_served(ours: Jails) -> None:
    entry = opened(ours)
    for slabs in ((1, -1, *SLABS[1:]), (1, *SLABS[:2], 0), (1, *SLABS[:2], 1 << 40), (1, 0, 1, 64)):
        with pytest.raises(RefusedError, match="sizes of slabs are out of range"):
            ours.share(MINE, m.ShareSlabs(entry.number, (slabs,)))
    for refused, why in ((((1, *SLABS),) * 2, "named twice"), (((2, *SLABS),), "no runner 2")):
        with pytest.raises(RefusedError, match=why):
            ours.share(MINE, m.ShareSlabs(entry.number, refused))
    small = opened(ours, limits=Limits(memory_bytes=sum(SLABS) - 1))
    with pytest.raises(RefusedError, match="larger than memory_bytes"):
        ours.share(MINE, m.ShareSlabs(small.number, ((1, *SLABS),)))


def test_another_hosts_client_chooses_no_larger_messages(ours: Jails) -> None:
    """What a runner says is held in the server's memory, which is many clients'."""
    theirs = served(Path("theirs"), local=False)
    wanted = 2 * DEFAULT_LIMITS.message_bytes
    for of, most in ((ours, wanted), (theirs, DEFAULT_LIMITS.message_bytes)):
        entry = opened(of, limits=Limits(message_bytes=wanted))
        assert entry.links[1].limits.message_bytes == most
    theirs.close()


def test_a_kept_jail_loses_so_many_runners(ours: Jails, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jails, "MAX_LOST", 0)
    entry = opened(ours)
    entry.lost[7] = whole_jail("exit")
    with pytest.raises(RefusedError, match="have died"):
        ours.start_more(MINE, m.StartRunners(entry.number, 1))


def test_zygotes_without_a_jail_are_few(ours: Jails) -> None:
    """A client may have a policy of its own for each jail; those that have one stay."""
    held = opened(ours, readable=("/held",))
    for number in range(2 * jails.MAX_IDLE_ZYGOTES + 2):
        opened(ours, readable=(f"/{number}",)).released = True
    assert len(_Spawner.alive) == jails.MAX_IDLE_ZYGOTES + 2  # and the last one
    opened(ours, readable=("/held",))
    assert held.zygote in {one.zygote for one in ours.open_ones()}
    assert len(_Spawner.alive) == jails.MAX_IDLE_ZYGOTES + 2


@pytest.mark.parametrize("local", [True, False])
def test_another_hosts_client_has_few_zygotes(local: bool) -> None:
    """Each is an interpreter, whose memory no limit of a jail counts; a user may have more."""
    of, most = served(Path("server"), local=local), jails.MAX_REMOTE_ZYGOTES

    def tried(first: int, stop: int) -> None:
        for number in range(first, stop):
            opened(of, environment={"TZ": f"UTC+{number}"})

    tried(0, most)
    tried(0, most)  # again, with the same ones
    if local:
        tried(most, most + 1)
    else:
        with pytest.raises(RefusedError, match="which is the most"):
            tried(most, most + 1)
    for entry in of.open_ones():
        entry.closing.append(MINE)
    tried(most, most + 1)
    of.close()

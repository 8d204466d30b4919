"""Records of a worker server: each of its jails, and the requests that wait for it."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, NamedTuple

from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.kinds import Buffer
from envhub_worker.protocol.confinement import Reason
from envhub_worker.spawn.jail import Jail
from envhub_worker.supervisor.idle_timer import IdleTimer
from envhub_worker.supervisor.output_tail import OutputTail
from envhub_worker.supervisor.runner_stream import RunnerLink

_MAX_SAID = 4096
"""Characters of a refusal."""


class Asker(NamedTuple):
    """Who asked: the reply goes to this identity under this id. Jails belong to its session.

    ``key`` was proved in the handshake; empty where none is needed.
    """

    identity: bytes
    request_id: int
    session: bytes = b""
    key: bytes = b""


Reply = Callable[..., None]
"""Sends the reply to a request: takes the asker, the message and perhaps its payload."""


class AnsweredError(Exception):
    """Ends a request early, with its reply."""

    def __init__(self, reply: m.Message) -> None:
        super().__init__(reply)
        self.reply = reply


class RefusedError(AnsweredError):
    """A request is not done. ``error`` is a name out of the client's table."""

    def __init__(self, error: str, message: str, missing: str = "", fix: str = "") -> None:
        # what the client has sent may be quoted in the message, at any length
        super().__init__(m.Refusal(error, message[:_MAX_SAID], missing, fix))
        self.error, self.message, self.missing, self.fix = error, message, missing, fix

    def __str__(self) -> str:
        return self.message


@dataclass
class Opening:
    """An ``OpenJail`` or ``StartRunners`` whose runners have not all come up."""

    asker: Asker
    waiting: set[int]
    runners: tuple[int, ...]
    since: float = field(default_factory=monotonic)


@dataclass(slots=True)
class Pending:
    """A ``Relay`` that runners still owe answers to."""

    asker: Asker
    operation: str
    replies: list[list[Buffer] | None]
    dead: set[int] = field(default_factory=set)
    since: float = field(default_factory=monotonic)

    def lost(self, index: int, death: m.Death) -> None:
        """In the place of a runner's answer: how it died."""
        self.dead.add(index)
        self.replies[index] = m.pack(m.replace(death, operation=self.operation))


@dataclass
class JailRecord:
    """A jail and everything that waits for it.

    Attributes:
        moved: Bytes to and from runners that it has lost.
        denied: What was tried in it and is denied, where it records that.
    """

    number: int
    name: str
    session: bytes
    jail: Jail
    zygote: tuple[object, ...]
    output: OutputTail
    links: dict[int, RunnerLink] = field(default_factory=dict)
    pids: dict[int, int] = field(default_factory=dict)
    report: tuple[object, ...] = ()
    opening: list[Opening] = field(default_factory=list)
    closing: list[Asker] = field(default_factory=list)
    kept: bool = False
    idle: IdleTimer | None = None
    lost: dict[int, m.Death] = field(default_factory=dict)
    death: m.Death | None = None
    released: bool = False
    opened: bool = False
    since: float = field(default_factory=monotonic)
    moved: tuple[int, int] = (0, 0)
    denied: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        # kept, because closing a descriptor makes it forget its number
        self.control = self.jail.fileno()

    def bytes_moved(self) -> tuple[int, int]:
        """To its runners, and from them."""
        sent, received = self.moved
        links = self.links.values()
        return sent + sum(one.sent for one in links), received + sum(one.received for one in links)

    def drop(self, runner: int) -> RunnerLink:
        """Its link to a runner, which it has no more."""
        link = self.links[runner]
        self.moved = self.moved[0] + link.sent, self.moved[1] + link.received
        return self.links.pop(runner)


def waiting(entry: JailRecord) -> list[Pending]:
    """Everything that runners owe an answer to; they owe it no more."""
    found = {}
    for link in entry.links.values():
        for pending, _ in link.owed:
            found[id(pending)] = pending
        link.owe_nothing()
    return list(found.values())


def owes(entry: JailRecord, runner: int) -> int:
    """How many answers a runner owes; one that has died owes none any more."""
    link = entry.links.get(runner)
    return 0 if link is None else len(link.owed)


def whole_jail(reason: Reason, **how: Any) -> m.Death:
    """A death that was not one runner's; ``how`` are further fields of ``Death``."""
    return m.Death(-1, reason, **how)


def signal_name(number: int | None) -> str | None:
    """``"SIGKILL"`` for 9. Trust: a jail may choose one that has no name, such as 40."""
    if number is None:
        return None
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


_STATES = {b"R": "running", b"S": "waiting", b"D": "waiting", b"T": "stopped", b"t": "stopped"}


def _state_of(pid: int) -> str:
    """What the kernel says that a runner is doing; a busy environment cannot say so itself."""
    try:
        return _STATES.get(procfs.stat(pid)[0], "gone")
    except (OSError, IndexError):
        return "gone"


def status_of(entry: JailRecord) -> dict[str, object]:
    """What a jail is doing, for ``Status``."""
    owed = [pending for link in entry.links.values() for pending, _ in link.owed]
    oldest = min(owed, key=lambda pending: pending.since, default=None)
    # in the order of the runners: they come up side by side, and say so in any order
    pids = tuple(entry.pids[runner] for runner in sorted(entry.pids))
    return {
        "jail": entry.number,
        "name": entry.name,
        "pids": pids,
        "states": tuple(map(_state_of, pids)),
        "busy_s": 0.0 if oldest is None else monotonic() - oldest.since,
        "operation": "" if oldest is None else oldest.operation,
    }

"""Records of a worker server: its jails with their output, idle time and waiting requests; and
``Witness``, whose methods are called for their events.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import traceback
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from time import monotonic
from typing import Any, NamedTuple

from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.shared_memory.words import SEQUENCE
from envhub_worker.protocol.text import printable
from envhub_worker.spawn.channel import close_fds
from envhub_worker.spawn.jail import Jail
from envhub_worker.supervisor.runner_stream import RunnerLink

_CHUNK = 1 << 16
MAX_BYTES = 1 << 20
"""Most bytes of output in one reply."""


class OutputTail:
    """The last ``limit`` bytes of a pipe that a jail writes to. Owns the descriptor.
    ``ended``: whether the pipe is at its end.
    """

    def __init__(self, fd: int, limit: int) -> None:
        self.ended = False
        self._fd = fd
        self._limit = limit
        self._kept = bytearray()  # up to twice the limit, so that few reads cut it
        self._total = 0  # bytes that were read so far: the offset at the end of ``_kept``

    def fileno(self) -> int:
        """The descriptor, or -1 once it is closed."""
        return self._fd

    def read(self) -> None:
        """Read waiting output. One read per call, so that a flood cannot block the server."""
        if self._fd < 0 or self.ended:
            return
        try:
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return
        self.ended = not data  # its watcher closes it: its number is soon another's
        self._kept += data
        self._total += len(data)
        if len(self._kept) > 2 * self._limit:
            del self._kept[: -self._limit]

    def since(self, offset: int) -> tuple[int, bytes]:
        """Returns the kept output from ``offset`` on, after the offset where it really begins."""
        first = self._total - len(self._kept)
        start = min(max(offset, first), self._total)
        return start, bytes(self._kept[start - first : start - first + MAX_BYTES])

    def text(self, lines: int = 40) -> str:
        """Returns the last lines, safe for a terminal. Drops a first line that is cut off: a client
        searches the lines for secrets and would not recognise half a secret.
        """
        kept = bytes(self._kept[-self._limit :])
        if len(kept) < self._total:
            kept = re.split(rb"[\r\n]", kept, maxsplit=1)[-1]
        text = kept.decode("utf-8", "backslashreplace")
        return printable("\n".join(text.splitlines()[-lines:]))

    def close(self) -> None:
        """Close the pipe. Idempotent."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


_WORD = 8
_MAX_PAIRS = 128


class IdleTimer:
    """Measures how long one jail has been idle."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        # Descriptors of (request, reply) by runner.
        self._slabs: dict[int, list[Sequence[int]]] = {}
        self._seen: list[int] = []  # the sequence words at the last look
        self.begin()

    def begin(self) -> None:
        """Restart the clock, after a request or an answer."""
        self._since = monotonic()

    def watch(self, runner: int, fds: Sequence[int]) -> None:
        """Count an environment's steps, too. Takes ownership of its request and reply slabs.

        Runners do not report closed environments; if there are many, the last ones are counted.
        """
        pairs = self._slabs.setdefault(runner, [])
        pairs.append(fds)
        if len(pairs) > _MAX_PAIRS:
            close_fds(pairs.pop(0))

    def forget(self, runner: int) -> None:
        """Forget a runner that has ended."""
        for fds in self._slabs.pop(runner, []):
            close_fds(fds)

    def close(self) -> None:
        """Close all descriptors."""
        for runner in list(self._slabs):
            self.forget(runner)

    def passed(self, busy: bool) -> bool:
        """Whether the jail was idle longer than its limit. ``busy``: a runner owes an answer."""
        # A step in shared memory is no message to the server. But each request and each answer
        # raises a sequence word: two equal and unchanged words mean that nobody has stepped since
        # the last look.
        pairs = [pair for pairs in self._slabs.values() for pair in pairs]
        sequences = [_sequence(request) for request, _ in pairs]
        answered = [_sequence(reply) for _, reply in pairs]
        if busy or sequences != answered or sequences + answered != self._seen:
            self._seen = sequences + answered
            self.begin()
        return monotonic() - self._since >= self.limit_s


def _sequence(slab: int) -> int:
    return int.from_bytes(os.pread(slab, _WORD, SEQUENCE * _WORD), "little")


_MAX_SAID = 4096
"""Characters of a refusal."""


class Asker(NamedTuple):
    """The sender of a request: the reply goes to its identity, with its id. Jails belong to its
    session.

    ``key`` was proved in the handshake; empty if the server needs no keys.
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
    """The server refuses a request. ``error`` is a name in the client's table."""

    def __init__(self, error: str, message: str, missing: str = "", fix: str = "") -> None:
        # The message may quote the client's request, which may have any length.
        super().__init__(m.Refusal(error, message[:_MAX_SAID], missing, fix))
        self.error, self.message, self.missing, self.fix = error, message, missing, fix

    def __str__(self) -> str:
        return self.message


@dataclass
class Opening:
    """An ``OpenJail`` or ``StartRunners`` some of whose runners have not started yet."""

    asker: Asker
    waiting: set[int]  # runners that have not started yet
    runners: tuple[int, ...]
    since: float = field(default_factory=monotonic)


@dataclass(slots=True)
class Pending:
    """A ``Relay`` that waits for runners' answers."""

    asker: Asker
    operation: str
    # In the order of the request's parts; None: not answered yet.
    replies: list[list[Buffer] | None]
    dead: set[int] = field(default_factory=set)  # indices of replies that are deaths
    since: float = field(default_factory=monotonic)

    def lost(self, index: int, death: m.Death) -> None:
        """Record a runner's death in place of its answer."""
        self.dead.add(index)
        self.replies[index] = m.pack(m.replace(death, operation=self.operation))


@dataclass
class JailRecord:
    """A jail and the requests that wait for it.

    Attributes:
        moved: Bytes to and from runners that have died.
        denied: The denied attempts of its processes, if it records them.
    """

    number: int  # random, so that it tells nothing of other clients' jails
    name: str
    session: bytes
    jail: Jail
    zygote: tuple[object, ...]  # the key of its spawner
    output: OutputTail
    links: dict[int, RunnerLink] = field(default_factory=dict)  # streams of the live runners
    # Of the live runners, once they are confined.
    pids: dict[int, int] = field(default_factory=dict)
    opening: list[Opening] = field(default_factory=list)  # requests that wait for runners
    closing: list[Asker] = field(default_factory=list)  # who waits for the end of all processes
    kept: bool = False  # goes on when a runner dies
    idle: IdleTimer | None = None  # None: it may be idle for ever
    lost: dict[int, m.Death] = field(default_factory=dict)  # deaths in a kept jail, by runner
    death: m.Death | None = None  # set once; the answer to every later request
    released: bool = False  # no process is left, and every descriptor is closed
    opened: bool = False  # a first request for runners has been answered
    since: float = field(default_factory=monotonic)
    moved: tuple[int, int] = (0, 0)
    denied: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        # Kept, because a closed object no longer knows its descriptor's number.
        self.control = self.jail.fileno()

    def bytes_moved(self) -> tuple[int, int]:
        """The bytes sent to its runners, and the bytes received from them."""
        sent, received = self.moved
        links = self.links.values()
        return sent + sum(link.sent for link in links), received + sum(
            link.received for link in links
        )

    def shared_bytes(self, but: Collection[object] = ()) -> int:
        """The bytes of slabs that the server shares with its runners, except those in ``but``."""
        others = (link.slabs for runner, link in self.links.items() if runner not in but)
        return sum(slabs.shared_bytes for slabs in others if slabs is not None)

    def drop(self, runner: int) -> RunnerLink:
        """Remove and return the link to a runner; its byte counts are kept."""
        link = self.links[runner]
        self.moved = self.moved[0] + link.sent, self.moved[1] + link.received
        return self.links.pop(runner)


def waiting(entry: JailRecord) -> list[Pending]:
    """Returns the requests that runners have not answered, and clears them."""
    states = {}
    for link in entry.links.values():
        for pending, _ in link.owed:
            states[id(pending)] = pending
        link.owe_nothing()
    return list(states.values())


def whole_jail(reason: Reason, **how: Any) -> m.Death:
    """Returns the death of a whole jail; ``how`` are further fields of ``Death``."""
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
    """Returns a runner's state by the kernel: a busy environment cannot report its own."""
    try:
        return _STATES.get(procfs.stat(pid)[0], "gone")
    except (OSError, IndexError):
        return "gone"


def status_of(entry: JailRecord) -> dict[str, object]:
    """Returns the state of a jail, for ``Status``."""
    owed = [pending for link in entry.links.values() for pending, _ in link.owed]
    oldest = min(owed, key=attrgetter("since"), default=None)
    # In the order of the runners, which start in parallel and report in any order.
    pids = tuple(entry.pids[runner] for runner in sorted(entry.pids))
    return {
        "jail": entry.number,
        "name": entry.name,
        "pids": pids,
        "states": tuple(map(_state_of, pids)),
        "busy_s": 0.0 if oldest is None else monotonic() - oldest.since,
        "operation": "" if oldest is None else oldest.operation,
    }


class Witness:
    """Its methods are called for events of every jail. They must neither raise nor keep arguments.

    This class records nothing: the server's client is on this machine and keeps its own log.
    """

    def opened(self, entry: JailRecord, runners: int, seconds: float) -> None:
        """A jail, or further runners in it, have started; with the time since the request."""

    def lost(self, entry: JailRecord, death: m.Death) -> None:
        """A runner has died in a jail that goes on."""

    def died(self, entry: JailRecord) -> None:
        """A jail is dead: ``entry.death`` says how."""

    def closed(self, entry: JailRecord) -> None:
        """All processes of a jail have ended, after its client or the server has closed it."""

    def failed(self, error: Exception) -> None:
        """Print an error of the server itself, which goes on, to stderr."""
        with contextlib.suppress(OSError, ValueError):  # stderr may have no reader any more
            traceback.print_exception(error)

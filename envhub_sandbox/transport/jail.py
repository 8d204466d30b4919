"""The client's end of one open jail: messages to its runners, and the jail's end."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from typing import Any

from envhub_sandbox.errors import (
    EnvHubError,
    RemoteEnvError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.remote_warnings import RemoteWarnings
from envhub_sandbox.transport.replies import (
    RunnersDiedError,
    check_reply,
    death,
    expect_reply,
    typed_reply,
)
from envhub_sandbox.transport.values import framed, unpacked
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.prefix import CHANGES, WATCHED_TYPES, Attribute

_CAUSE_S = 10.0
_CAUSE_POLL_S = 0.01
_UNSEEN_S = 5.0
"""How long ``open_jail``, interrupted or late, waits for the jail's number, to end it."""


Frames = list[Buffer]
Unpack = Callable[[int, Frames], Any]
"""Decodes a runner's frames; its first argument is the runner's index in the request."""


class Request:
    """One message to each shard, encoded once for the lane, the crash history and a recovery.

    Args:
        operation: What the user called.
        messages: One for each shard.
        frames: The frames of each message.
        bounds: The slices of the sub-environments, one for each shard.
        plain: Whether no value in the messages had to be pickled.

    ``sent``: the frames to send, where they differ from ``frames``, which are recorded.
    """

    __slots__ = ("_kept", "bounds", "frames", "messages", "operation", "plain", "sent")

    def __init__(
        self,
        operation: str,
        messages: Sequence[m.Message],
        frames: Sequence[Frames],
        bounds: list[tuple[int, int]],
        *,
        plain: bool,
    ) -> None:
        self.operation = operation
        self.messages = messages
        self.frames = self.sent = frames
        self.bounds = bounds
        self.plain = plain
        self._kept: list[list[bytes]] | None = None  # made when they are first needed

    def kept(self) -> list[list[bytes]]:
        """Copies of the frames; the frames of large values are views of memory that may change."""
        if self._kept is None:
            self._kept = [list(map(bytes, frames)) for frames in self.frames]
        return self._kept


class JailHandle:
    """An open jail. Not thread-safe: its owner holds a lock.

    Attributes:
        number: The number that the server gave the jail.
        runners: The numbers of its runners, in the order of the shards.
        kept: Whether the jail stays open when one of its runners dies.
        report: One mapping for each layer of the confinement, with ``layer``, ``enforced`` and
            ``detail``; layers of a container around the jail are in it, too.
        limits: Bounds on its messages.
        attaching: Held from the deposit of descriptors for a runner until it has taken them.
        before_end: Called before the jail is ended, to fetch its last output.
        warnings: The warnings of its repository.
        watched: The values of the attributes that its runners watch.
    """

    def __init__(
        self,
        client: WorkerConnection,
        number: int,
        runners: Sequence[int],
        report: list[dict[str, Any]],
        limits: WireLimits,
    ) -> None:
        self.client = client
        self.number = number
        self.runners = list(runners)
        self.kept = False
        self.report = report
        self.attaching = threading.RLock()  # interruption.md, rule 12
        self.before_end: Callable[[], None] = _nothing
        self.warnings = RemoteWarnings()
        self.watched = WatchedAttributes()
        self.limits = limits
        self._asked: dict[int, int] = {}  # how many runners, by request

    def through(self, client: WorkerConnection) -> JailHandle:
        """A handle on the same jail over another connection."""
        jail = JailHandle(client, self.number, self.runners, self.report, self.limits)
        jail.before_end, jail.warnings, jail.watched = self.before_end, self.warnings, self.watched
        jail.attaching = self.attaching
        return jail

    def start_runners(self, count: int, deadline: Deadline) -> list[int]:
        """Fork further runners; returns their numbers."""
        reply, _ = self.client.request(m.StartRunners(self.number, count), deadline=deadline)
        started = _runners(expect_reply(reply, m.JailOpened), count)
        self.runners += started
        return started

    def keep(self, runners: bool, idle_s: float | None, deadline: Deadline) -> None:
        """Keep the jail when one of its ``runners`` dies, but no longer than ``idle_s`` when it is
        idle. Asks the server only if it would do otherwise.
        """
        idle_ms = 0 if idle_s in (None, float("inf")) else max(1, int(idle_s * 1000))
        if idle_ms or (runners and not self.kept):
            message = m.KeepJail(self.number, runners, idle_ms)
            expect_reply(self.client.request(message, deadline=deadline)[0], m.Done)
            self.kept = self.kept or runners

    def replace_runners(self, dead: Sequence[int], deadline: Deadline) -> list[int]:
        """Fork a new runner for each dead one; returns the new numbers, in order."""
        self.watched.forget()
        self.runners = [runner for runner in self.runners if runner not in dead]
        return self.start_runners(len(dead), deadline)

    def pack(self, message: m.Message) -> Frames:
        """The frames of a message to a runner."""
        # The client pickles the caller's own objects here only, and never unpickles anything.
        return m.pack(message, pickler=framed, limits=self.limits)

    def request(
        self, operation: str, messages: Sequence[m.Message], bounds: list[tuple[int, int]]
    ) -> Request:
        """Encode one message for each shard; returns the request, ready to be sent.
        Raises ``LocalProtocolError``: a message cannot be sent.
        """
        pickled = False

        def pickler(value: object) -> bytes | memoryview:
            nonlocal pickled
            pickled = True
            return framed(value)

        frames = [m.pack(message, pickler=pickler, limits=self.limits) for message in messages]
        return Request(operation, messages, frames, bounds, plain=not pickled)

    def relay(
        self, operation: str, requests: Sequence[tuple[int, Frames]], *, deposited: bool = False
    ) -> int:
        """Send each of some runners a packed message, all in one request; returns its id.
        ``deposited``: whether the runners get the deposited descriptors with it; see ``Relay``.
        """
        parts = tuple((runner, len(frames)) for runner, frames in requests)
        payload = [frame for _, frames in requests for frame in frames]
        return self.send_relay(m.Relay(self.number, operation, parts, deposited), payload)

    def send_relay(self, relay: m.Relay, payload: Sequence[Buffer]) -> int:
        """Send a ``Relay`` with the frames for its runners; returns the request's id."""
        request_id = self.client.send(relay, payload)
        self._asked[request_id] = len(relay.parts)
        return request_id

    def receive(
        self, request_id: int, deadline: Deadline, unpack: Unpack | None = None
    ) -> list[Any]:
        """The runners' replies, in the order of the request, decoded by ``unpack`` if given.
        Raises ``WorkerTimeoutError``: the deadline came first; ``WorkerDiedError``: the jail
        ended; ``RunnersDiedError``: runners of a kept jail died; ``RemoteProtocolError``: a runner
        broke the protocol.
        """
        reply, payload = self.client.receive(request_id, deadline)
        count = self._asked.pop(request_id, None)
        with UNTRUSTED:
            if type(reply) is not m.RelayDone:
                reply = expect_reply(reply, m.RelayDone)
            if reply.dead and not self.kept:
                raise RemoteProtocolError("the worker names dead runners of a jail that ends")
            parts = _cut(payload, reply.parts)
            if len(parts) != count:
                raise RemoteProtocolError(f"{count} runners were asked, {len(parts)} answered")
            unpack = unpack or self._unpack
            if reply.dead:
                raise self._died(reply.dead, parts, unpack)
            return [unpack(index, part) for index, part in enumerate(parts)]

    def arrived(self, request_id: int) -> list[Frames]:
        """Each runner's frames, if they have arrived, without removing them; empty for an error."""
        reply, payload = self.client.peek(request_id)
        if type(reply) is not m.RelayDone or reply.dead:
            return []
        try:
            with UNTRUSTED:
                parts = _cut(payload, reply.parts)
        except RemoteProtocolError:  # ``receive`` raises it
            return []
        return parts if len(parts) == self._asked.get(request_id) else []

    def forget(self, request_id: int) -> None:
        """Drop the runners' answers to a request."""
        self._asked.pop(request_id, None)
        self.client.forget(request_id)

    def _died(self, dead: Sequence[int], parts: list[Frames], unpack: Unpack) -> RunnersDiedError:
        """The error for deaths of runners, which only the server can report."""
        if not set(dead) <= set(range(len(parts))):
            raise RemoteProtocolError("the worker names dead runners that were not asked")
        messages = {index: self._unpack(index, parts[index]) for index in dead}
        deaths = {
            index: death(typed_reply(message, m.Death)) for index, message in messages.items()
        }
        living = [None if i in deaths else unpack(i, part) for i, part in enumerate(parts)]
        return RunnersDiedError(living, deaths)

    def _unpack(self, _: int, frames: Sequence[Buffer]) -> m.Message:
        if len(frames) > 1:  # a single frame has no prefixes (warnings, changed attributes)
            frames = self.warnings.take(self.watched.take(frames))
        return unpacked(frames, limits=self.limits)

    def exchange(
        self,
        operation: str,
        requests: Sequence[tuple[int, m.Message]],
        deadline: Deadline,
        *,
        deposited: bool = False,
    ) -> list[m.Message]:
        """``ask`` with messages that are not packed; raises the first exception in the replies."""
        packed = [(runner, self.pack(message)) for runner, message in requests]
        replies = self.ask(operation, packed, deadline, deposited=deposited)
        for reply in replies:
            check_reply(reply)
        return replies

    def ask(
        self,
        operation: str,
        requests: Sequence[tuple[int, Frames]],
        deadline: Deadline,
        *,
        deposited: bool = False,
    ) -> list[m.Message]:
        """Send packed messages to runners; returns the replies. Raises the first death."""
        try:
            return self.receive(self.relay(operation, requests, deposited=deposited), deadline)
        except RunnersDiedError as error:
            raise error.first from None

    def check(self, operation: str, deadline: Deadline) -> None:
        """Ask whether the jail lives.
        Raises ``WorkerDiedError``: it has ended during ``operation``.
        """
        reply, _ = self.client.request(m.CheckJail(self.number, operation), deadline=deadline)
        expect_reply(reply, m.Done)

    def cause_of_death(self, operation: str) -> Exception:
        """Ask the server why the jail has ended, until it has reaped it; returns the error."""
        deadline = Deadline(_CAUSE_S)
        while not deadline.passed:
            try:
                self.check(operation, deadline)
            except EnvHubError as error:
                return error
            time.sleep(_CAUSE_POLL_S)
        return WorkerDiedError(f"the worker process died during {operation}", request=operation)

    def close(self, deadline: Deadline) -> None:
        """End the jail and everything in it; without effect if the server has ended."""
        self.ask_to_close()(deadline)

    def ask_to_close(self) -> Callable[[Deadline], None]:
        """The first half of ``close``; returns the second, which waits for the jail's end."""
        # Before the request: an ended jail's output cannot be read any more.
        self.before_end()
        request: int | None = None
        try:
            request = self.client.send(m.CloseJail(self.number))
        except WorkerError:
            pass
        except BaseException:  # interruption.md, rule 7: the request may not have left
            self._part(None, Deadline(0))
            raise
        return partial(self._part, request)

    def _part(self, request: int | None, deadline: Deadline) -> None:
        try:
            if request is not None:
                self.client.receive(request, deadline)
        except WorkerError:
            pass
        finally:
            self.drop()

    def drop(self) -> None:
        """Close the connection to a jail that has ended or is about to. Idempotent."""
        self.client.let_go(self.number)
        self.client.close()


def _cut(payload: Frames, counts: Sequence[int]) -> list[Frames]:
    """Cut the payload into parts of ``counts`` frames each. Trust: input from the worker."""
    if len(counts) == 1 and type(counts[0]) is int and counts[0] == len(payload) > 0:
        return [payload]
    if any(type(count) is not int or count < 1 for count in counts) or sum(counts) != len(payload):
        raise RemoteProtocolError("the worker's frames do not add up")
    frames = iter(payload)
    return [list(islice(frames, count)) for count in counts]


def _nothing() -> None:
    """The default of ``before_end``, for a jail whose output is not followed."""


def open_jail(
    client: WorkerConnection, request: m.OpenJail, limits: WireLimits, deadline: Deadline
) -> JailHandle:
    """Open a jail. Raises ``SandboxUnavailableError``: a layer cannot be enforced."""
    sent = client.send(request)
    try:
        reply, _ = client.receive(sent, deadline)
        opened = expect_reply(reply, m.JailOpened)
        runners = _runners(opened, request.runners)
        report = [dict(layer) for layer in opened.report if isinstance(layer, dict)]
        # Keeps it alive from now on: a server on another host ends a jail that no client holds.
        client.hold(opened.jail)
        return JailHandle(client, opened.jail, runners, report, limits)
    except BaseException as error:  # interruption.md, rule 6
        if isinstance(error, WorkerTimeoutError) or not isinstance(error, EnvHubError):
            _end_unseen(client, sent)
        raise


def _end_unseen(client: WorkerConnection, sent: int) -> None:
    """End the jail that a request opens, whether or not the reply has been read."""
    deadline = Deadline(_UNSEEN_S)
    with contextlib.suppress(EnvHubError):
        opened = expect_reply(client.reply_again(sent, deadline), m.JailOpened)
        client.request(m.CloseJail(opened.jail), deadline=deadline)
        client.let_go(opened.jail)


def _runners(opened: m.JailOpened, count: int) -> list[int]:
    """The numbers of the started runners, ``count`` different ones. Trust: the worker's reply."""
    runners = list(opened.runners)
    are_numbers = all(type(runner) is int for runner in runners)
    if not are_numbers or not len(set(runners)) == len(runners) == count:
        raise RemoteProtocolError(f"the worker did not start {count} runners, each with a number")
    return runners


AttributeAnswer = tuple[Any, ...] | RemoteEnvError
"""The attribute's value in each sub-environment, or the error that reading it raises."""


_MOST_SEEDED = 4096
"""Environments of one jail, of which a worker may name any."""


class WatchedAttributes:
    """The values of watched attributes, by the environment's number and the attribute's name.

    Each reply names the attributes that have changed since the last reply. All others still have
    the values that are kept here, so reading them needs no request. Trust: the values come from
    the worker, like the result of a ``call``. They have immutable types, so a caller cannot change
    a kept value.
    """

    def __init__(self) -> None:
        self._values: dict[Attribute, AttributeAnswer] = {}
        self._seeded: set[int] = set()  # environments whose spaces a reset has seeded

    def take_seeded(self, number: int) -> bool:
        """Whether a reset has seeded the spaces of an environment since the last call."""
        seeded = number in self._seeded
        self._seeded.discard(number)
        return seeded

    def note(self, number: int, name: str, values: AttributeAnswer) -> bool:
        """Keep values that were read. Returns whether their types allow that."""
        if type(values) is tuple and any(type(value) not in WATCHED_TYPES for value in values):
            return False
        self._values[number, name] = values
        return True

    def values(self, number: int, name: str) -> AttributeAnswer | None:
        """The kept values, one for each sub-environment, or the kept error; None if unknown."""
        return self._values.get((number, name))

    def forget(self) -> None:
        """Drop all values: a runner was replaced, or a reply was lost."""
        self._values.clear()

    def take(self, frames: Sequence[Buffer]) -> Sequence[Buffer]:
        """Drop the attributes that a reply says have changed; returns the reply's other frames.
        Trust: input from the worker. Raises ``RemoteProtocolError``: the prefix is malformed.
        """
        if len(frames) >= DEFAULT_LIMITS.frames:  # the reply had no room for a frame of changes
            self.forget()
        changed, rest = CHANGES.read(frames)
        for attribute in changed:
            self._values.pop(attribute, None)
            if attribute[1] == m.SPACES and len(self._seeded) < _MOST_SEEDED:
                self._seeded.add(attribute[0])
        return rest

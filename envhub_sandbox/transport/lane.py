"""Lanes: the ways of an environment's requests to its runners, over the server or faster.

There are three. ``Lane``, below, sends each request to the server, which passes it on.
``ServedLane`` does the same with faster steps. ``SharedMemoryLane`` needs no server for steps and
small messages. The common part of the latter two is in ``shared_memory/slab_lane``.
``session/builder`` chooses the lane once, when it builds the environment. The meaning of a request
does not depend on the lane.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import EnvHubError, WorkerError
from envhub_sandbox.transport.connection import Source
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import Frames, JailHandle, Request, Unpack
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import Results, StepResult, all_replies
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.spaces import batches

RECHECK_MS = 2
"""When to look again after going to sleep: a runner may have answered just before, unnoticed."""
LOOK_MS = 500
"""The longest wait for the first of several lanes, so that a lost connection over a network is
noticed in between."""


class Lane:
    """Sends the requests of one environment to its runners over ZeroMQ and the server, one request
    at a time; several steps one after the other, where it ``takes_more``. Other lanes derive from
    it to make steps faster.

    The order of calls matters:

    1. ``send_step`` or ``send``.
    2. ``wait`` or ``replies``. Their deadline also bounds further fetches, as of large infos.
       If this wait ends without all answers, the lane remembers which answers are owed.
       ``catch_up`` must then take them before the next request is sent, which would otherwise get
       the answers to this one.
    3. ``result``. It never waits, so an exception from it is never a signal handler's.

    Args:
        jail: The jail of the runners.
        runners: The number of each shard's runner.
        number: The environment's number in the jail.
        declared: Checks the answers against the manifest and joins them.

    Attributes:
        name: The lane's name in a crash bundle.
        elapsed_ns: The time of the last step, from its sending to the last answer.
    """

    name = "frames"

    def __init__(
        self, jail: JailHandle, runners: Sequence[int], number: int, declared: Results
    ) -> None:
        self.jail = jail
        self.runners = list(runners)
        self.number = number
        self.elapsed_ns = 0
        self.declared = declared
        self._asked_ns = 0
        self._answers: list[m.Message] = []  # of the step that ``wait`` has waited for
        self._owed: deque[tuple[int, int, Unpack | None]] = deque()  # id, send time, decoder
        self._sending = False  # whether it is unknown if a message left

    @property
    def takes_more(self) -> bool:
        """Whether a step can be sent while answers to earlier steps, in order, are still owed.

        Not in a kept jail: a runner that replaces a dead one repeats only the last request.
        """
        return len(self.runners) == 1 and not self.jail.kept

    def expect_more(self) -> None:
        """Note that a step waits for the last answer, so that the lane ``takes_more`` later."""

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """Send a validated batch of actions, to each shard its slice.

        Args:
            actions: The batch.
            ahead: Whether answers to earlier steps are owed, which ``takes_more`` permits.

        Raises:
            EnvHubError: Nothing was sent.
        """
        self._asked_ns = perf_counter_ns()
        bounds = self.declared.slices
        parts = [actions]
        if len(bounds) > 1:
            parts = batches.split(self.declared.manifest.single_action_space, actions, bounds)
        packed = [self.jail.pack(m.Step(self.number, part)) for part in parts]
        self._send_to_all("step", packed, ahead=ahead)

    def wait(self, deadline: Deadline) -> None:
        """Wait until every shard has answered the step, including its infos.

        Raises:
            WorkerTimeoutError: The deadline came first.
            WorkerDiedError: The jail has ended.
            RunnersDiedError: Runners of a kept jail died; it has the others' answers.
            RemoteProtocolError: A runner broke the rules.
        """
        asked_ns = self._owed[0][1]
        self._answers = self.replies(deadline)
        self.elapsed_ns = perf_counter_ns() - asked_ns

    def result(self) -> StepResult:
        """The tuple that ``VectorEnv.step`` returns.

        Trust: input from the worker.
        Raises ``RemoteEnvError``: the repository's code raised, or the infos cannot be joined;
        ``RemoteProtocolError``: a runner broke the rules.
        """
        # not kept, so that the next batch can use the memory of one that the caller has dropped
        answers, self._answers = self._answers, []
        return self.declared.step(all_replies(answers, m.StepDone))

    def send(self, request: Request) -> None:
        """Send each shard its message.
        Raises ``EnvHubError``: nothing was sent.
        """
        self._asked_ns = perf_counter_ns()
        self._send_to_all(request.operation, request.sent)

    def _send_to_all(
        self, operation: str, packed: Sequence[Frames], *, ahead: bool = False
    ) -> None:
        self.send_some(operation, self.runners, packed, ahead=ahead)

    def send_some(
        self,
        operation: str,
        runners: Sequence[int],
        packed: Sequence[Frames],
        *,
        ahead: bool = False,
    ) -> None:
        """Send each of some runners a packed message; ``replies`` returns their answers."""
        parts = list(zip(runners, packed, strict=True))
        self._send(partial(self.jail.relay, operation, parts), ahead=ahead)

    def _send(
        self, relay: Callable[[], int], unpack: Unpack | None = None, *, ahead: bool = False
    ) -> None:
        """Send by ``relay``; ``unpack`` decodes answers that are not messages."""
        while self._owed and not ahead:  # such as infos that are no longer needed: a shard raised
            self.jail.forget(self._owed.popleft()[0])
        self._sending = True  # interruption.md, rule 1: half a message, or a whole one
        try:
            self._owed.append((relay(), self._asked_ns, unpack))
            if ahead:
                self.jail.client.keep(self._owed[-1][0])
        except EnvHubError:  # nothing was sent
            self._sending = False
            raise
        self._sending = False

    def replies(self, deadline: Deadline) -> list[Any]:
        """Every shard's reply to the request; raises as ``wait`` does."""
        try:
            sent, _, unpack = self._owed[0]
            received = self.jail.receive(sent, deadline, unpack)
        except RunnersDiedError:  # this is an answer, so it is owed no more
            self._owed.popleft()
            raise
        self._owed.popleft()
        return received

    def answered(self) -> bool:
        """Whether ``wait`` or ``replies`` would return or raise at once.

        Never waits, and removes no answer. After False, call it again when one of the lane's
        ``sources`` is readable, and at least twice a second, to notice an end.
        """
        return not self._owed or self.jail.client.arrived(self._owed[0][0])

    def sources(self) -> list[Source]:
        """The descriptors and sockets that become readable when ``answered`` may return True.

        They may be up to ``RECHECK_MS`` late. Valid while an answer is owed.
        """
        return self.jail.client.sources()

    def catch_up(self, deadline: Deadline) -> None:
        """Take the answers that are owed and drop them; raises as ``wait`` does.
        Raises ``WorkerError``: an interrupt came while the request was sent or its answer read, so
        the lane does not know what is owed.
        """
        if self._sending or self.jail.client.torn:
            raise WorkerError("the request was interrupted while it was sent, or its answer taken")
        while self._owed:  # the server's answers; a derived lane takes those in slabs itself
            Lane.replies(self, deadline)

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """Replace the runners that have died.

        Args:
            dead: The shards whose runners died.
            fresh: The new runner of each, which has built its sub-environments already.
            deadline: Bounds the whole call.
        """
        for index, runner in zip(dead, fresh, strict=True):
            self.runners[index] = runner

    def of_shard(self, shard: int) -> Lane:
        """A lane of messages to one shard alone; call ``leave_slots`` before each message."""
        results = Results(self.declared.manifest, [self.declared.bounds[shard]])
        results.apart, results.max_bytes = self.declared.apart, self.declared.max_bytes
        return Lane(self.jail, [self.runners[shard]], self.number, results)

    def leave_slots(self) -> None:
        """Have the shards write into no slot that a caller may hold; for results by messages."""

    def owe_for(self, other: Lane) -> None:
        """Add the answers that another lane of this jail is owed, for ``catch_up`` to take."""
        self._owed.extend(other._owed)
        self._sending = self._sending or other._sending

    def traffic(self) -> tuple[int, int, int]:
        """Stale replies, and bytes sent and received, so far."""
        client = self.jail.client
        return client.stale_replies, client.sent_bytes, client.received_bytes

    def close(self) -> None:
        """Release the lane's own resources, which do not include the jail."""


def answered_first(lanes: Sequence[Lane], deadline: Deadline) -> list[int]:
    """The indices of the lanes that have answered or ended; empty if the deadline came first.

    Sleeps until there is such a lane. A hostile lane that always claims to have answered, or
    rings without end, does not hide others: all lanes are looked at, at least twice a second.
    """
    import zmq

    everywhere = range(len(lanes))
    answered = _answered(lanes, everywhere)
    if answered or deadline.passed:
        return answered
    poller, places = zmq.Poller(), _listen(lanes)
    for source in places:
        poller.register(source, zmq.POLLIN)
    look = Deadline(RECHECK_MS / 1000)  # an answer may have come just before we listened
    while not answered and not deadline.passed:
        left_ms, look_ms = deadline.left_ms(), look.left_ms() or 0
        rung = poller.poll(look_ms if left_ms is None else min(look_ms, left_ms))
        some: Iterable[int] = sorted({index for source, _ in rung for index in places[source]})
        if look.passed:  # reached even if a lane rings without end
            some, look = everywhere, Deadline(LOOK_MS / 1000)
        answered = _answered(lanes, some)
    return answered


def _listen(lanes: Sequence[Lane]) -> dict[Source, list[int]]:
    """The sources to poll, each with the indices of its lanes; lanes in one server share some."""
    places: dict[Source, list[int]] = {}
    for index, lane in enumerate(lanes):
        for source in lane.sources():
            places.setdefault(source, []).append(index)
    return places


def _answered(lanes: Sequence[Lane], places: Iterable[int]) -> list[int]:
    return [index for index in places if lanes[index].answered()]

"""The way of an environment's requests to its runners: over the server, or a faster one.

There are three: ``Lane``, below; ``ServedLane``, which is the same with faster steps; and
``SharedMemoryLane``, whose steps and small messages need no server. What these two have in common
is in ``shared_memory/slab_lane``. Which of them an environment has is decided once, when it is
built (``session/builder``). What a request means does not depend on the lane.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
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
"""After how long to look once more where a doorbell may have crossed with our going to sleep."""
LOOK_MS = 500
"""One wait for the first of several lanes: those over a network have to be asked in between whether
they are still there."""


class Lane:
    """The way to the runners of one environment: one request at a time, and its answers; or
    several steps one after the other, where it ``takes_more``.

    The order is the point. ``send_step`` or ``send`` comes first, then ``wait`` or ``replies``, for
    which a deadline is given that also bounds whatever else has to be fetched. Where that wait ends
    in any other way than with answers, the lane still knows what it is owed, and ``catch_up`` must
    take it before anything else is sent: a step's answer would otherwise be taken for the next's.
    ``result`` waits for nothing, so that what it raises is never a signal handler's.

    This one goes over ZeroMQ and the server, which passes frames on to the runners; those that are
    derived of it have faster steps.

    Args:
        jail: Where the runners are.
        runners: One for each shard.
        number: What the environment is called there.
        declared: What its answers are held against.

    Attributes:
        name: What a crash bundle calls it.
        jail, runners, number, declared: As given.
        elapsed_ns: What the last step took, from its sending to the last answer.
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
        self._answers: list[m.Message] = []
        self._owed: deque[tuple[int, int, Unpack | None]] = deque()  # requests, and since when
        self._sending = False

    @property
    def takes_more(self) -> bool:
        """Whether a step can be sent while earlier ones are owed; answers come in that order.

        What a fresh runner may have to repeat is the last request alone.
        """
        return len(self.runners) == 1 and not self.jail.kept

    def expect_more(self) -> None:
        """A step waits for the answer to the last. If the lane can, it ``takes_more`` next time."""

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """Send a validated batch of actions: to each shard its slice.

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
        """Until every shard has answered the step, with all that belongs to it.

        Raises:
            WorkerTimeoutError: The deadline came first.
            WorkerDiedError: The jail has ended.
            RunnersDiedError: Runners of a kept jail did; it has what the others answered.
            RemoteProtocolError: A runner broke the rules.
        """
        asked_ns = self._owed[0][1]
        self._answers = self.replies(deadline)
        self.elapsed_ns = perf_counter_ns() - asked_ns

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """What ``VectorEnv.step`` returns; with these infos, if there are other ones.

        Trust: input from the worker.

        Raises:
            Misfit: The shards' infos do not go together; ``send_for_infos`` asks for others.
            RemoteEnvError: The repository's code raised.
            RemoteProtocolError: A runner broke the rules.
        """
        # not kept: a large batch that its owner has dropped is memory for the next
        answers, self._answers = self._answers, []
        try:
            return self.declared.step(all_replies(answers, m.StepDone), infos)
        except batches.Misfit:
            self._answers = answers  # to be joined once more, with other infos
            raise

    def send(self, request: Request) -> None:
        """Send each shard its message.

        Raises:
            EnvHubError: Nothing was sent.
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
        """Send some runners a message each; ``replies`` has what they answer."""
        parts = list(zip(runners, packed, strict=True))
        self._send(lambda: self.jail.relay(operation, parts), ahead=ahead)

    def _send(
        self, relay: Callable[[], int], unpack: Unpack | None = None, *, ahead: bool = False
    ) -> None:
        """Send by ``relay``; ``unpack`` makes messages of the answers, where these are none."""
        while self._owed and not ahead:  # such as infos, of a step that another has raised in
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

    def send_for_infos(self, *, failed: bool = False) -> None:
        """Ask for the last infos as each sub-environment gave them; ``replies`` has them.

        Or say that the step has ``failed``, since those cannot be joined.

        Raises:
            EnvHubError: Nothing was sent.
        """
        packed = [self.jail.pack(m.FetchInfosApart(self.number, failed))] * len(self.runners)
        self.send_some("step", self.runners, packed)

    def replies(self, deadline: Deadline) -> list[Any]:
        """Every shard's reply to what was sent; raises as ``wait`` does."""
        try:
            sent, _, unpack = self._owed[0]
            received = self.jail.receive(sent, deadline, unpack)
        except RunnersDiedError:  # that was the answer
            self._owed.popleft()
            raise
        self._owed.popleft()
        return received

    def answered(self) -> bool:
        """Whether ``wait``, or ``replies``, has nothing to wait for: it returns, or raises.

        Never waits itself, and takes nothing away. Where it says no, it is asked again once one of
        its ``sources`` is readable, and at least twice a second; an end may be seen only then.
        """
        return not self._owed or self.jail.client.arrived(self._owed[0][0])

    def sources(self) -> list[Source]:
        """What becomes readable, at the latest ``RECHECK_MS`` late, when ``answered`` may say yes.

        For as long as what was sent is owed.
        """
        return self.jail.client.sources()

    def catch_up(self, deadline: Deadline) -> None:
        """Take what is owed and drop it; raises as ``wait`` does.

        Raises:
            WorkerError: The sending was interrupted: what was sent is not known.
        """
        if self._sending or self.jail.client.torn:
            raise WorkerError("the request was interrupted while it was sent, or its answer taken")
        while self._owed:  # by the server: a derived lane is owed other answers as well
            Lane.replies(self, deadline)

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """Go to other runners in the place of those that have died.

        Args:
            dead: Their shards.
            fresh: The runner of each, in which the environment is built already.
            deadline: For all of it.
        """
        for index, runner in zip(dead, fresh, strict=True):
            self.runners[index] = runner

    def of_shard(self, shard: int) -> Lane:
        """A way to one shard alone, by messages: before each of them ``leave_slots`` is called."""
        results = Results(self.declared.manifest, [self.declared.bounds[shard]])
        results.apart, results.max_bytes = self.declared.apart, self.declared.max_bytes
        return Lane(self.jail, [self.runners[shard]], self.number, results)

    def leave_slots(self) -> None:
        """Results come another way next: no shard may write where a batch is held."""

    def owe_for(self, other: Lane) -> None:
        """Have ``catch_up`` take what another lane of this jail is owed."""
        self._owed.extend(other._owed)
        self._sending = self._sending or other._sending

    def traffic(self) -> tuple[int, int, int]:
        """Stale replies, and bytes sent and received, so far."""
        client = self.jail.client
        return client.stale_replies, client.sent_bytes, client.received_bytes

    def close(self) -> None:
        """Give back what is its own; the jail is not."""


def answered_first(lanes: Sequence[Lane], deadline: Deadline) -> list[int]:
    """The places of those that have answered, or ended; none where the deadline came first.

    Sleeps until there is one. A lane that always claims to have answered, or rings without end,
    keeps no other from being found.
    """
    import zmq

    everywhere = range(len(lanes))
    answered = _answered(lanes, everywhere)
    if answered or deadline.passed:
        return answered
    poller, places = zmq.Poller(), _listen(lanes)
    for source in places:
        poller.register(source, zmq.POLLIN)
    look = Deadline(RECHECK_MS / 1000)  # an answer may have crossed with our beginning to listen
    while not answered and not deadline.passed:
        left_ms, look_ms = deadline.left_ms(), look.left_ms() or 0
        rung = poller.poll(look_ms if left_ms is None else min(look_ms, left_ms))
        some: Iterable[int] = sorted({index for source, _ in rung for index in places[source]})
        if look.passed:  # also where one rings without end
            some, look = everywhere, Deadline(LOOK_MS / 1000)
        answered = _answered(lanes, some)
    return answered


def _listen(lanes: Sequence[Lane]) -> dict[Source, list[int]]:
    """What is to be polled, and for which lanes: those in one server share some of it."""
    places: dict[Source, list[int]] = {}
    for index, lane in enumerate(lanes):
        for source in lane.sources():
            places.setdefault(source, []).append(index)
    return places


def _answered(lanes: Sequence[Lane], places: Iterable[int]) -> list[int]:
    return [index for index in places if lanes[index].answered()]

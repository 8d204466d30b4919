"""The way of an environment's requests to its runners: one interface, and the way over the server.

There are two: ``RelayLane``, below, and ``SharedMemoryLane``. Which of them an environment has is
decided once, when it is built (``session/jails/builder``). What a request means does not depend on
the lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any, Protocol

from envhub_sandbox.errors import EnvHubError, WorkerError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle, RunnersDiedError
from envhub_sandbox.transport.replies import all_replies
from envhub_sandbox.transport.results import Results, StepResult
from envhub_sandbox.transport.values import pickles
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.spaces import batches

Frames = list[Buffer]


class Request:
    """What each shard is sent: made and encoded once, for the lane, the history and a recovery.

    Args:
        operation: What the user called.
        messages: One for each shard.
        frames: Those of each message.
        bounds: The slices of the sub-environments, one for each shard.
        plain: Whether there is nothing in them that only pickle could carry.
    """

    __slots__ = ("_kept", "bounds", "frames", "messages", "operation", "plain")

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
        self.frames = frames
        self.bounds = bounds
        self.plain = plain
        self._kept: list[list[bytes]] | None = None

    def kept(self) -> list[list[bytes]]:
        """The frames, copied: large values are sent from where they lie, and may change."""
        if self._kept is None:
            self._kept = [list(map(bytes, frames)) for frames in self.frames]
        return self._kept


class Lane(Protocol):
    """The way to the runners of one environment: one request at a time, and its answers.

    The order is the point. ``send_step`` or ``send`` comes first, then ``wait`` or ``replies``, for
    which a deadline is given that also bounds whatever else has to be fetched. Where that wait ends
    in any other way than with answers, the lane still knows what it is owed, and ``catch_up`` must
    take it before anything else is sent: a step's answer would otherwise be taken for the next's.
    ``result`` waits for nothing, so that what it raises is never a signal handler's.

    Attributes:
        name: What a crash bundle calls it.
        jail: Where its runners are.
        runners: One for each shard.
        number: What the environment is called there.
        elapsed_ns: What the last step took, from its sending to the last answer.
    """

    name: str
    jail: JailHandle
    runners: list[int]
    number: int
    elapsed_ns: int

    def send_step(self, actions: Any) -> None:
        """Send a validated batch of actions: to each shard its slice.

        Raises:
            EnvHubError: Nothing was sent.
        """

    def wait(self, deadline: Deadline) -> None:
        """Until every shard has answered the step, with all that belongs to it.

        Raises:
            WorkerTimeoutError: The deadline came first.
            WorkerDiedError: The jail has ended.
            RunnersDiedError: Runners of a kept jail did; it has what the others answered.
            RemoteProtocolError: A runner broke the rules.
        """

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """What ``VectorEnv.step`` returns; with these infos, if there are other ones.

        Raises:
            Misfit: The shards' infos do not go together; ``send_for_infos`` asks for others.
            RemoteEnvError: The repository's code raised.
            RemoteProtocolError: A runner broke the rules.
        """

    def request(self, operation: str, messages: Sequence[m.Message]) -> Request:
        """A request of a message for each shard, ready to be sent.

        Raises:
            LocalProtocolError: It cannot be sent.
        """

    def send(self, request: Request) -> None:
        """Send each shard its message.

        Raises:
            EnvHubError: Nothing was sent.
        """

    def send_for_infos(self) -> None:
        """Ask for the last infos as each sub-environment gave them; ``replies`` has them.

        Raises:
            EnvHubError: Nothing was sent.
        """

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """Every shard's reply to what was sent; raises as ``wait`` does."""

    def catch_up(self, deadline: Deadline) -> None:
        """Take what is owed and drop it; raises as ``wait`` does.

        Raises:
            WorkerError: The sending was interrupted: what was sent is not known.
        """

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """Go to other runners in the place of those that have died.

        Args:
            dead: Their shards.
            fresh: The runner of each, in which the environment is built already.
            deadline: For all of it.
        """

    def traffic(self) -> tuple[int, int, int]:
        """Stale replies, and bytes sent and received, so far."""

    def close(self) -> None:
        """Give back what is its own; the jail is not."""


class RelayLane:
    """Over ZeroMQ and the server, which passes frames on to the runners: see ``Lane``.

    Args:
        jail: Where the runners are.
        runners: One for each shard.
        number: What the environment is called there.
        results: What is declared of its answers.
    """

    name = "frames"

    def __init__(
        self, jail: JailHandle, runners: Sequence[int], number: int, results: Results
    ) -> None:
        self.jail = jail
        self.runners = list(runners)
        self.number = number
        self.elapsed_ns = 0
        self._results = results
        self._asked_ns = 0
        self._answers: list[m.Message] = []
        self._owed: int | None = None
        self._sending = False

    def send_step(self, actions: Any) -> None:
        """See ``Lane``."""
        self._asked_ns = perf_counter_ns()
        bounds = self._results.bounds
        parts = [actions]
        if len(bounds) > 1:
            parts = batches.split(self._results.manifest.single_action_space, actions, bounds)
        messages = [m.Step(self.number, part) for part in parts]
        self.send_some("step", self.runners, list(map(self.jail.pack, messages)))

    def wait(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        self._answers = self.replies(deadline)
        self.elapsed_ns = perf_counter_ns() - self._asked_ns

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """See ``Lane``. Trust: input from the worker."""
        # not kept: a large batch that its owner has dropped is memory for the next
        answers, self._answers = self._answers, []
        try:
            return self._results.step(all_replies(answers, m.StepDone), infos)
        except batches.Misfit:
            self._answers = answers  # to be joined once more, with other infos
            raise

    def request(self, operation: str, messages: Sequence[m.Message]) -> Request:
        """See ``Lane``."""
        pickler, limits = _NotingPickler(), self.jail.limits
        frames = [m.pack(message, pickler=pickler, limits=limits) for message in messages]
        return Request(operation, messages, frames, self._results.bounds, plain=pickler.plain)

    def send(self, request: Request) -> None:
        """See ``Lane``."""
        self.send_some(request.operation, self.runners, request.frames)

    def send_some(self, operation: str, runners: Sequence[int], packed: Sequence[Frames]) -> None:
        """Send some runners a message each; ``replies`` has what they answer."""
        self._owed = None
        self._sending = True  # interruption.md, rule 1: half a message, or a whole one
        try:
            self._owed = self.jail.relay(operation, list(zip(runners, packed, strict=True)))
        except EnvHubError:  # nothing was sent
            self._sending = False
            raise
        self._sending = False

    def send_for_infos(self) -> None:
        """See ``Lane``."""
        packed = [self.jail.pack(m.FetchInfosApart(self.number))] * len(self.runners)
        self.send_some("step", self.runners, packed)

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """See ``Lane``."""
        assert self._owed is not None
        try:
            received = self.jail.receive(self._owed, deadline)
        except RunnersDiedError:  # that was the answer
            self._owed = None
            raise
        self._owed = None
        return received

    def catch_up(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        if self._sending:
            raise WorkerError("the request was interrupted while it was being sent")
        if self._owed is not None:
            self.replies(deadline)

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """See ``Lane``."""
        for index, runner in zip(dead, fresh, strict=True):
            self.runners[index] = runner

    def traffic(self) -> tuple[int, int, int]:
        """See ``Lane``."""
        client = self.jail.client
        return client.stale_replies, client.sent_bytes, client.received_bytes

    def close(self) -> None:
        """There is nothing but the jail."""


class _NotingPickler:
    """Pickles the caller's own objects, and notes that it has. Nothing is ever unpickled here."""

    def __init__(self) -> None:
        self.plain = True

    def __call__(self, value: object) -> bytes | memoryview:
        self.plain = False
        return pickles.framed(value)

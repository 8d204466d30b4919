"""Answers that lie in slabs, whoever holds the other end for us: a runner, or the server.

What did not fit there is fetched over the server (``SlabLane``). Steps in columns are those of
plain sub-environments with spaces of a fixed layout (``ColumnSteps``).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.client_slabs import (
    JoinedColumns,
    Outcome,
    ShardSlabs,
    infos_of,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches

if TYPE_CHECKING:
    from envhub_sandbox.transport.shared_memory.client_slabs import ObservationSlab
    from envhub_sandbox.transport.shared_memory.served_lane import ReceivedBatch

STEP = "step"


class SlabLane(Lane):
    """A lane that fetches what did not fit the slabs: see ``Lane``.
    ``shards``: the slabs of each.
    """

    shards: Sequence[ShardSlabs]

    def __init__(self, relay: Lane) -> None:
        super().__init__(relay.jail, relay.runners, relay.number, relay.declared)
        self._asked = STEP
        self._fetching: tuple[int, Sequence[int]] = 0, ()  # for which request, of which shards
        self._settled_ns = 0  # the request of which ``answered`` has found all answers

    @property
    @abstractmethod
    def _by_server(self) -> bool:
        """Whether the answer that is owed is one of messages over the server."""

    @abstractmethod
    def _incomplete(self) -> list[int] | None:
        """The shards whose answers are there, and did not fit; None if one is not there."""

    def _has_ended(self) -> bool:
        """Whether there is nothing to wait for although a shard has not answered."""
        return False

    def answered(self) -> bool:
        """See ``Lane``. What has to be fetched is asked for here: a runner may never give it."""
        if self._by_server:
            return super().answered()
        if self._settled_ns == self._asked_ns:
            return True
        if self._fetching[0] != self._asked_ns:
            missing = self._incomplete()
            if missing is None:
                return self._has_ended()
            try:
                if missing:
                    self._ask_for(missing, ahead=True)
            except EnvHubError:  # whoever waits asks again, and meets the same
                return True
            self._fetching = self._asked_ns, missing
        if self._fetching[1] and not self.jail.client.arrived(self._owed[-1][0]):
            return False
        self._settled_ns = self._asked_ns
        return True

    def _ask_for(self, shards: Sequence[int], *, ahead: bool = False) -> None:
        packed = [self.jail.pack(m.FetchInfos(self.number))] * len(shards)
        runners = [self.runners[index] for index in shards]
        self.send_some(self._asked, runners, packed, ahead=ahead)

    def _fetched(
        self, missing: Sequence[int], deaths: dict[int, WorkerDiedError], deadline: Deadline
    ) -> dict[int, m.Message | None]:
        """What did not fit, by shards. Who dies meanwhile is added to the deaths.

        Trust: input from the worker. An answer that says after ``answered`` that more has to be
        fetched is refused: that may never come, and others wait meanwhile.
        """
        asked = missing
        if self._fetching[0] == self._asked_ns:
            asked = self._fetching[1]
            if not set(missing) <= set(asked):
                raise RemoteProtocolError("the worker has changed an answer that was there already")
            self._fetching = 0, ()
        elif missing:
            self._ask_for(missing)
        if not asked:
            return {}
        replies: Sequence[m.Message | None]
        try:
            replies = Lane.replies(self, deadline)
        except RunnersDiedError as error:
            replies = error.replies
            deaths.update({asked[place]: death for place, death in error.deaths.items()})
        return {i: reply for i, reply in zip(asked, replies, strict=True) if i in missing}

    def catch_up(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        super().catch_up(deadline)
        # with what ``answered`` has asked for besides: it is asked for anew
        self._settled_ns, self._fetching = 0, (0, ())


class ColumnSteps(SlabLane):
    """Steps whose actions and results have a layout: see ``Lane``.

    Args:
        layout: Where a shard's actions lie.
        batch: Where all shards have their results.
        rest: As the next class in line has it.
    """

    def __init__(
        self, layout: slabs.Layout, batch: ObservationSlab | ReceivedBatch, relay: Lane, *rest: Any
    ) -> None:
        super().__init__(relay, *rest)
        self._bounds = self.declared.slices
        self._batch = batch
        self._action_space = self.declared.manifest.single_action_space
        self._flat_actions = len(layout.actions) == 1 and not layout.actions[0].path
        self._said: list[Outcome] = []
        self._joined = JoinedColumns((), ())

    @abstractmethod
    def _outcomes(self, deadline: Deadline) -> tuple[list[Outcome], dict[int, WorkerDiedError]]:
        """Every shard's outcome, once it has answered, and who has died before; nothing at all if
        none says more than its results. Raises as ``Lane.wait``.
        """

    def _rows(self, actions: Any) -> Iterable[list[Any]]:
        """Each shard's actions, by leaves."""
        leaves = [actions] if self._flat_actions else slabs.flatten(self._action_space, actions)
        if len(self._bounds) == 1:
            return [leaves]
        return ([leaf[start:stop] for leaf in leaves] for start, stop in self._bounds)

    def wait(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        self._said, deaths = self._outcomes(deadline)
        kinds = [kind for kind, _ in self._said]
        # what one has raised comes before the infos of others, unless a recovery needs these, or
        # they were asked for: warnings come with them
        if deaths or self._owed or (slabs.FETCH in kinds and slabs.RAISED not in kinds):
            missing = [index for index, kind in enumerate(kinds) if kind == slabs.FETCH]
            for index, reply in self._fetched(missing, deaths, deadline).items():
                self._said[index] = slabs.DONE, reply
        if deaths:
            raise RunnersDiedError(self._stepped(deaths), deaths)

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """See ``Lane``. Trust: input from the worker."""
        if infos is None:
            infos = self._infos() if self._said else {}
        return (self._batch.take(), *self._batch.results(), infos)

    def _infos(self) -> dict[Any, Any]:
        if len(self.shards) > 1 and all(kind == slabs.COLUMNS for kind, _ in self._said):
            schemas = [shard.schema for shard in self.shards]
            if not self._joined.is_of(schemas):
                self._joined = JoinedColumns(schemas, self._bounds)
            if self._joined.columns:
                return self._joined.infos()
        shards = zip(self.shards, self._said, strict=True)
        parts = [infos_of(shard, outcome, self.declared) for shard, outcome in shards]
        return self.declared.infos(parts)

    def _stepped(self, deaths: Collection[int]) -> list[m.Message | None]:
        """What the living wrote, as messages. Trust: input from the worker."""
        with UNTRUSTED:
            parts, flags = self._observations(), self._batch.results()
            return [
                None if index in deaths else self._step_done(index, part, flags)
                for index, part in enumerate(parts)
            ]

    def _step_done(self, index: int, observation: Any, flags: Any) -> m.Message:
        outcome = self._said[index]
        if isinstance(outcome[1], m.RaisedException):
            return outcome[1]
        rewards, over, cut = (column[slice(*self._bounds[index])] for column in flags)
        info = infos_of(self.shards[index], outcome, self.declared)
        return m.StepDone(observation, rewards, over, cut, info)

    def _observations(self) -> list[Any]:
        """The rows of each shard."""
        space = self.declared.manifest.single_observation_space
        return list(batches.split(space, self._batch.take(), self._bounds))

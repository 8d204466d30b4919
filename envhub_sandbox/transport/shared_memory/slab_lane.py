"""The common part of lanes with slabs, whose other end is at a runner or at the server.

``SlabLane`` fetches answers that did not fit the slabs over the server. ``ColumnSteps`` steps in
columns, for plain sub-environments with spaces of a fixed layout.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Protocol

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

STEP = "step"
_COLUMNS: list[Outcome] = [(slabs.COLUMNS, None)]


class StepBatch(Protocol):
    """The results of one step of all shards; each method is called once a step."""

    def take(self) -> Any:
        """The observations, in the structure of the space."""

    def results(self) -> tuple[Any, Any, Any]:
        """Rewards (float64), terminations, truncations (bool), ``(num_envs,)``."""


class SlabLane(Lane):
    """A lane that fetches answers that did not fit the slabs over the server: see ``Lane``.
    ``shards``: the slabs of each shard.
    """

    shards: Sequence[ShardSlabs]

    def __init__(self, relay: Lane) -> None:
        super().__init__(relay.jail, relay.runners, relay.number, relay.declared)
        self._asked = STEP  # the operation of the request that is to be answered
        self._fetching: tuple[int, Sequence[int]] = 0, ()  # request's time, shards
        self._settled_ns = 0  # time of the request whose answers ``answered`` has all found

    @property
    @abstractmethod
    def _by_server(self) -> bool:
        """Whether the answer that is owed comes as messages over the server."""

    @abstractmethod
    def _incomplete(self) -> list[int] | None:
        """The shards whose answers did not fit; None if a shard has not answered yet."""

    def _has_ended(self) -> bool:
        """Whether a process has ended, so that there is nothing to wait for."""
        return False

    def answered(self) -> bool:
        """Implements ``Lane.answered``; also asks for infos that did not fit, without waiting."""
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
            except EnvHubError:  # ``wait`` asks again, and raises it
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
        """Fetch the answers of the ``missing`` shards; adds new deaths to ``deaths``.

        Trust: input from the worker. After ``answered``, a jail may not change its answer to one
        that has to be fetched: that might never come, and other workers would wait.
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
        """Implements ``Lane.catch_up``."""
        super().catch_up(deadline)
        # this has dropped the fetches of ``answered``, too, which are repeated if needed
        self._settled_ns, self._fetching = 0, (0, ())


class ColumnSteps(SlabLane):
    """Steps whose actions and results are columns with a fixed layout: see ``Lane``.

    Args:
        layout: The layout of a shard's actions.
        batch: The results of all shards.
        rest: Further arguments of the next class in the method resolution order.
    """

    def __init__(self, layout: slabs.Layout, batch: StepBatch, relay: Lane, *rest: Any) -> None:
        super().__init__(relay, *rest)
        self._bounds = self.declared.slices
        self._batch = batch
        self._action_space = self.declared.manifest.single_action_space
        self._flat_actions = len(layout.actions) == 1 and not layout.actions[0].path  # one array
        self._said: list[Outcome] = []  # of the last step; empty if all shards had results only
        self._joined = JoinedColumns((), ())  # of the last schemas

    @abstractmethod
    def _outcomes(self, deadline: Deadline) -> tuple[list[Outcome], dict[int, WorkerDiedError]]:
        """Wait; returns every shard's outcome, and the deaths. The outcomes are empty if all
        shards have results only. Raises as ``Lane.wait``.
        """

    def _rows(self, actions: Any) -> Iterable[list[Any]]:
        """Each shard's slice of the leaves of the actions."""
        leaves = [actions] if self._flat_actions else slabs.flatten(self._action_space, actions)
        if len(self._bounds) == 1:
            return [leaves]
        return ([leaf[start:stop] for leaf in leaves] for start, stop in self._bounds)

    def wait(self, deadline: Deadline) -> None:
        """Implements ``Lane.wait``."""
        self._said, deaths = self._outcomes(deadline)
        if not (self._said or deaths or self._owed):
            return  # as usual: results only
        kinds = [kind for kind, _ in self._said]
        # If a shard raised, the infos of others are not fetched, unless a recovery needs them, or
        # they were requested already: warnings come with them.
        if deaths or self._owed or (slabs.FETCH in kinds and slabs.RAISED not in kinds):
            missing = [index for index, kind in enumerate(kinds) if kind == slabs.FETCH]
            for index, reply in self._fetched(missing, deaths, deadline).items():
                self._said[index] = slabs.DONE, reply
        if deaths:
            raise RunnersDiedError(self._stepped(deaths), deaths)

    def result(self) -> StepResult:
        """Implements ``Lane.result``. Trust: input from the worker."""
        observation, (rewards, over, cut) = self._batch.take(), self._batch.results()
        return observation, rewards, over, cut, self._infos() if self._said else {}

    def _infos(self) -> dict[Any, Any]:
        if self._said == _COLUMNS and not self.declared.is_sliced:
            return self.shards[0].columns()
        joins = len(self.shards) > 1 and not self.declared.unjoined
        if joins and all(kind == slabs.COLUMNS for kind, _ in self._said):
            schemas = [shard.schema for shard in self.shards]
            if not self._joined.is_of(schemas):
                self._joined = JoinedColumns(schemas, self._bounds)
            if self._joined.columns:
                return self._joined.infos()
        shards = zip(self.shards, self._said, strict=True)
        parts = [infos_of(shard, outcome, self.declared) for shard, outcome in shards]
        return self.declared.infos(parts)

    def _stepped(self, deaths: Collection[int]) -> list[m.Message | None]:
        """The results of the living shards, as messages. Trust: input from the worker."""
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
        """Each shard's rows of the observations."""
        space = self.declared.manifest.single_observation_space
        return list(batches.split(space, self._batch.take(), self._bounds))

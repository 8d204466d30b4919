"""The fast lane of plain sub-environments with spaces of a fixed layout: steps in columns.

A step costs one wake-up per shard and one copy out. Infos that did not fit go over the server.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.attachment import Attachment
from envhub_sandbox.transport.shared_memory.client_slabs import (
    JoinedColumns,
    ObservationSlab,
    Outcome,
    SlotRing,
    action_layouts,
    by_shard,
    infos_of,
)
from envhub_sandbox.transport.shared_memory.lane import STEP, RunnerGoneError, SharedMemoryLane
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches

_CAUSE_S = 10.0
_NOTHING: list[Outcome] = []


class ColumnLane(SharedMemoryLane):
    """See ``SharedMemoryLane``.

    Args:
        observed: Where the observations lie.
    """

    def __init__(
        self,
        relay: Lane,
        observed: slabs.ObservationLayout,
        layouts: Sequence[slabs.Layout],
        attachment: Attachment,
    ) -> None:
        manifest = relay.declared.manifest
        self.observations = ObservationSlab(manifest.single_observation_space, observed)
        super().__init__(relay, layouts, [self.observations] * len(layouts), attachment)
        self._bounds = relay.declared.slices
        self._action_space = manifest.single_action_space
        leaves = layouts[0].actions
        self._flat_actions = len(leaves) == 1 and not leaves[0].path
        self._said = _NOTHING
        self._joined = JoinedColumns((), ())
        self._steps = 0
        self._step_bytes = sum(one.action_bytes for one in layouts), observed.batch_bytes

    @classmethod
    def open(
        cls, relay: Lane, attachment: Attachment, deadline: Deadline, *, slots: int
    ) -> ColumnLane | None:
        """See ``SharedMemoryLane``; None also where the spaces have no fixed layout."""
        results = relay.declared
        space = results.manifest.single_observation_space
        observed = slabs.observation_layout(space, results.count, slots)
        layouts = action_layouts(results)
        if observed is None or layouts is None:
            attachment.close()
            return None
        lane = cls(relay, observed, layouts, attachment)
        return lane if lane.agree(deadline) else None

    def _attach_message(self, index: int) -> m.Attach:
        layout = self.observations.layout
        return m.Attach(self.number, self._bounds[index][0], layout.count, layout.slots)

    def _fresh_slots(self, index: int) -> SlotRing:
        return self.observations  # the others write there, too

    def _slot_for(self, operation: str, index: int) -> tuple[int, SlotRing | None]:
        if operation == "reset" and not index:
            self.observations.choose()
        return self.observations.chosen, None

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """See ``Lane``."""
        self._asked = STEP  # interruption.md, rule 1: first
        self._steps += 1
        leaves = [actions] if self._flat_actions else slabs.flatten(self._action_space, actions)
        self._asked_ns = perf_counter_ns()
        self._spin = self._step_spin
        spin_ns = self._spin.budget_ns
        slot = self.observations.choose()
        if len(self.shards) == 1:
            self.shards[0].ask(leaves, (slot, spin_ns, 0))
            return
        # the first ones start while the last ones are still asked: with many, each moment counts
        asked = zip(self.shards, self._bounds, self._cores.of_shards(), strict=True)
        flat = self._flat_actions
        for index, (shard, (start, stop), cpu) in enumerate(asked):
            wishes = slot, spin_ns if index < self._awake else 0, cpu
            rows = [actions[start:stop]] if flat else [leaf[start:stop] for leaf in leaves]
            shard.ask(rows, wishes)

    def wait(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        outcomes = self._outcomes(deadline)
        self._said = self._with_fetched(outcomes, deadline) if outcomes else _NOTHING

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """See ``Lane``. Trust: input from the worker."""
        if infos is None:
            infos = self._infos() if self._said else {}
        return (self.observations.take(), *self.observations.results(), infos)

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

    def _outcomes(self, deadline: Deadline) -> list[Outcome]:
        """Every shard's outcome; nothing at all if none says more than its results."""
        try:
            self._wait_for_all(deadline)
        except RunnerGoneError:
            self._meet_deaths(deadline)
        for shard in self.shards:
            if not shard.has_nothing_to_say():
                return [shard.outcome() for shard in self.shards]
        return _NOTHING

    def _with_fetched(self, outcomes: list[Outcome], deadline: Deadline) -> list[Outcome]:
        """The same with the infos that did not fit; what one has raised comes before them."""
        kinds = [kind for kind, _ in outcomes]
        asked = self._fetching[0] == self._asked_ns  # then they are taken: warnings come with them
        if slabs.FETCH not in kinds or (slabs.RAISED in kinds and not asked):
            return outcomes
        missing = [index for index, kind in enumerate(kinds) if kind == slabs.FETCH]
        self._refuse_further(missing)
        try:
            replies = self._fetch(missing, deadline)
        except RunnersDiedError as error:
            raise self._died(by_shard(error, missing), deadline) from None
        for index, reply in zip(missing, replies, strict=True):
            outcomes[index] = slabs.DONE, reply
        return outcomes

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """See ``Lane``."""
        replies = super().replies(deadline)
        return self._with_observations(replies) if self._asked == "reset" else replies

    def catch_up(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        if self._asked == STEP:
            self._catch_up_with_server(deadline)
            self._outcomes(deadline)  # it may carry the schema of later columns
        else:
            super().catch_up(deadline)

    def _with_observations(self, replies: Sequence[m.Message]) -> list[m.Message]:
        """Replies to a reset as they would have come through the server."""
        with UNTRUSTED:
            return [
                reply
                if isinstance(reply, m.RaisedException)
                else m.ResetDone(part, self.declared.info(reply))
                for part, reply in zip(self._observations(), replies, strict=True)
            ]

    def _observations(self) -> list[Any]:
        """The rows of each shard."""
        space = self.declared.manifest.single_observation_space
        return list(batches.split(space, self.observations.take(), self._bounds))

    # --- deaths --------------------------------------------------------------------------------

    def _meet_deaths(self, deadline: Deadline) -> None:
        """Return where a kept jail's runners have all answered before one of them died.

        Raises:
            RunnersDiedError: Some have not; all the others have.
            WorkerDiedError: The jail has ended.
            WorkerTimeoutError: The deadline came before the answer of one that lives.
        """
        if not self.jail.kept:
            raise self.jail.cause_of_death(self._asked) from None
        answers = self._attachment.answers
        dead = [i for i, shard in enumerate(self.shards) if not answers(i, shard, deadline)]
        if dead:
            raise self._died(self._deaths_of(dead), deadline) from None

    def _deaths_of(self, dead: Sequence[int]) -> dict[int, WorkerDiedError]:
        try:  # the server knows how, at the latest when they have been reaped
            self._fetch(dead, Deadline(_CAUSE_S))
        except RunnersDiedError as error:
            return by_shard(error, dead)
        raise RemoteProtocolError("the worker says that a process lives which has died")

    def _died(self, deaths: dict[int, WorkerDiedError], deadline: Deadline) -> RunnersDiedError:
        """Deaths in a step, and what the living wrote, as the messages that it stands for.

        Who dies before his infos are fetched is added to the deaths. Trust: input from the worker.
        """
        living: dict[int, Outcome] = {}
        for index, shard in enumerate(self.shards):
            if index in deaths:
                continue
            try:
                outcome = shard.outcome()
                if outcome[0] == slabs.FETCH:
                    outcome = slabs.DONE, self._fetch([index], deadline)[0]
                living[index] = outcome
            except RunnersDiedError as error:
                deaths[index] = error.first
            except WorkerDiedError as error:
                deaths[index] = error
        replies: list[m.Message | None] = [None] * len(self.shards)
        with UNTRUSTED:
            parts, flags = self._observations(), self.observations.results()
            for index, said in living.items():
                replies[index] = self._stepped(index, said, parts[index], flags)
        return RunnersDiedError(replies, deaths)

    def _stepped(self, index: int, outcome: Outcome, observation: Any, flags: Any) -> m.Message:
        if isinstance(outcome[1], m.RaisedException):
            return outcome[1]
        rewards, over, cut = (column[slice(*self._bounds[index])] for column in flags)
        info = infos_of(self.shards[index], outcome, self.declared)
        return m.StepDone(observation, rewards, over, cut, info)

    def traffic(self) -> tuple[int, int, int]:
        """See ``Lane``; of steps in shared memory, infos are left out."""
        stale, sent, received = super().traffic()
        there, back = self._step_bytes
        return stale, sent + there * self._steps, received + back * self._steps

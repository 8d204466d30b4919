"""The fast lane of plain sub-environments with spaces of a fixed layout: steps in columns.

A step costs one wake-up per shard and one copy out. Infos that did not fit go over the server.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import WorkerDiedError
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
    infos_of,
)
from envhub_sandbox.transport.shared_memory.lane import STEP, SharedMemoryLane
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches

_NOTHING: list[Outcome] = []
_NO_MORE: Outcome = (slabs.DONE, None)


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
        deaths = self._wait_for_all(deadline)
        self._said = self._outcomes(deaths)
        if self._said:
            self._take_infos(deaths, deadline)
        if deaths:
            raise RunnersDiedError(self._stepped(deaths), deaths)

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

    def _outcomes(self, deaths: Collection[int]) -> list[Outcome]:
        """Every shard's outcome; nothing at all if none says more than its results."""
        for shard in self.shards:
            if deaths or not shard.has_nothing_to_say():
                return [
                    _NO_MORE if index in deaths else shard.outcome()
                    for index, shard in enumerate(self.shards)
                ]
        return _NOTHING

    def _take_infos(self, deaths: dict[int, WorkerDiedError], deadline: Deadline) -> None:
        """Put the infos in that did not fit.

        What one has raised comes before them, unless a recovery needs them or they were asked for:
        warnings come with them.
        """
        kinds = [kind for kind, _ in self._said]
        if deaths or self._fetching[0] == self._asked_ns or slabs.RAISED not in kinds:
            missing = [index for index, kind in enumerate(kinds) if kind == slabs.FETCH]
            for index, reply in self._fetched(missing, deaths, deadline).items():
                self._said[index] = slabs.DONE, reply

    def _drop(self, deaths: dict[int, WorkerDiedError]) -> None:
        if self._asked == STEP:
            self._outcomes(deaths)  # it may carry the schema of later columns
        super()._drop(deaths)

    def _as_messages(self, answers: list[m.Message | None]) -> list[m.Message | None]:
        """See ``SharedMemoryLane``: the observations of a reset lie in the slab."""
        if self._asked != "reset":
            return answers
        with UNTRUSTED:
            return [
                reply
                if reply is None or isinstance(reply, m.RaisedException)
                else m.ResetDone(part, self.declared.info(reply))
                for part, reply in zip(self._observations(), answers, strict=True)
            ]

    def _observations(self) -> list[Any]:
        """The rows of each shard."""
        space = self.declared.manifest.single_observation_space
        return list(batches.split(space, self.observations.take(), self._bounds))

    def _stepped(self, deaths: Collection[int]) -> list[m.Message | None]:
        """What the living wrote, as messages. Trust: input from the worker."""
        with UNTRUSTED:
            flags, replies = self.observations.results(), []
            for index, part in enumerate(self._observations()):
                replies.append(None if index in deaths else self._step_done(index, part, flags))
        return replies

    def _step_done(self, index: int, observation: Any, flags: Any) -> m.Message:
        outcome = self._said[index]
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

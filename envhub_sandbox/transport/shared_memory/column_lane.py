"""The lane in shared memory for spaces with a fixed layout: steps are columns, not messages.

A step costs one wake-up per shard and one copy of the results. Infos that do not fit the slab come
over the server.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.shared_memory.attachment import Attachment
from envhub_sandbox.transport.shared_memory.client_slabs import (
    NO_MORE,
    LaneShard,
    ObservationSlab,
    Outcome,
    SlotRing,
    action_layouts,
)
from envhub_sandbox.transport.shared_memory.lane import SharedMemoryLane
from envhub_sandbox.transport.shared_memory.slab_lane import STEP, ColumnSteps
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.shared_memory import slabs

_NOTHING: list[Outcome] = []


class ColumnLane(ColumnSteps, SharedMemoryLane):
    """Steps in columns (``ColumnSteps``), messages as in ``SharedMemoryLane``.
    ``observed``: the layout of the observations.
    """

    shards: list[LaneShard]

    def __init__(
        self,
        relay: Lane,
        observed: slabs.ObservationLayout,
        layouts: Sequence[slabs.Layout],
        attachment: Attachment,
    ) -> None:
        self.observations = ObservationSlab(
            relay.declared.manifest.single_observation_space, observed
        )
        slots = [self.observations] * len(layouts)
        super().__init__(layouts[0], self.observations, relay, layouts, slots, attachment)
        self._steps = 0  # so far, for ``traffic``
        self._step_bytes = sum(one.action_bytes for one in layouts), observed.batch_bytes

    @classmethod
    def open(
        cls, relay: Lane, attach: Callable[[], Attachment], deadline: Deadline, *, slots: int
    ) -> SharedMemoryLane | None:
        """As ``SharedMemoryLane.open``; None also if the spaces have no fixed layout."""
        results = relay.declared
        space = results.manifest.single_observation_space
        observed = slabs.observation_layout(space, results.count, slots)
        layouts = action_layouts(results)
        if observed is None or layouts is None:
            return None
        return cls(relay, observed, layouts, attach()).agreed(deadline)

    def _attach_message(self, index: int) -> m.Attach:
        layout = self.observations.layout
        return m.Attach(self.number, self._bounds[index][0], layout.count, layout.slots)

    def _fresh_slots(self, index: int) -> SlotRing:
        return self.observations  # all shards write into this one slab

    def _slot_for(self, operation: str, index: int) -> tuple[int, SlotRing | None]:
        if operation == "reset" and not index:
            self.observations.choose()
        return self.observations.chosen, None

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """Implements ``Lane.send_step``."""
        self._asked = STEP  # interruption.md, rule 1: before anything is sent
        self._steps += 1
        rows = self._rows(actions)
        self._asked_ns = perf_counter_ns()
        self._spin = self._step_spin
        slot = self.observations.choose()
        if slot != self._wishes[0][0]:
            self._plan(slot)
        # each shard starts as soon as its actions are written, while the next are still written
        for index, leaves in enumerate(rows):
            shard = self.shards[index]
            shard.write(leaves, self._wishes[index])
            shard.announce()
        # the shards compute meanwhile, so nobody waits for what follows
        self._plan(slot)
        self.observations.prepare()
        if len(self.shards) == 1:
            shard.prepare()

    def _outcomes(self, deadline: Deadline) -> tuple[list[Outcome], dict[int, WorkerDiedError]]:
        deaths = self._wait_for_all(deadline)
        return self._read(deaths), deaths

    def _read(self, deaths: Collection[int]) -> list[Outcome]:
        for shard in self.shards:
            if deaths or not shard.has_nothing_to_say():
                return [
                    NO_MORE if index in deaths else shard.outcome()
                    for index, shard in enumerate(self.shards)
                ]
        return _NOTHING

    def _drop(self, deaths: dict[int, WorkerDiedError]) -> None:
        if self._asked == STEP:
            self._read(deaths)  # an outcome may have the schema of later columns
        super()._drop(deaths)

    def _as_messages(self, answers: list[m.Message | None]) -> list[m.Message | None]:
        """Implements ``SharedMemoryLane._as_messages``; a reset's observations are in the slab."""
        if self._asked != "reset":
            return answers
        with UNTRUSTED:
            return [
                reply
                if reply is None or isinstance(reply, m.RaisedException)
                else m.ResetDone(part, self.declared.info(reply))
                for part, reply in zip(self._observations(), answers, strict=True)
            ]

    def traffic(self) -> tuple[int, int, int]:
        """Implements ``Lane.traffic``; infos of steps in shared memory are not counted."""
        stale, sent, received = super().traffic()
        there, back = self._step_bytes
        return stale, sent + there * self._steps, received + back * self._steps

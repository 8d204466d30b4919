"""The lane in shared memory: messages, also steps, go straight to the jail's runners.

A message that does not fit the slabs goes over the server, as on ``Lane``. ``ColumnLane`` derives
from this lane, and steps without messages.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.system.log import MESSAGES
from envhub_sandbox.system.platform import own_cpus
from envhub_sandbox.transport.connection import Source
from envhub_sandbox.transport.deadline import Cores, Deadline, SpinChooser
from envhub_sandbox.transport.jail import Frames
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError, typed_reply
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.attachment import Attachment
from envhub_sandbox.transport.shared_memory.client_slabs import (
    LaneShard,
    SlotRing,
    Wishes,
    message_layouts,
)
from envhub_sandbox.transport.shared_memory.slab_lane import STEP, SlabLane
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs

# On other machines a core may see the sequence word before the data that it announces: there we
# sleep and do not poll.
_ORDERED_STORES = platform.machine() in ("x86_64", "AMD64")
BY_SERVER = ""
"""The value of ``_asked`` when the answer comes over the server, not through the slabs."""
_BULKY = frozenset({"render"})
"""Operations whose answers hardly ever fit the slabs."""
_BATCHES = frozenset({STEP, "reset"})
"""Operations that return a batch of observations, which goes into a slot."""
_CAUSE_S = 10.0
"""How long the server may take to say how a runner died."""


class SharedMemoryLane(SlabLane):
    """Sends requests through slabs and doorbells, one set for each shard: see ``Lane``.

    Args:
        relay: The lane over the server, to the same runners.
        layouts: The layout of each shard's request slab.
        slots: Each shard's ring of slots for the answers to steps.
        attachment: Gives the other ends of the slabs to the runners.

    Attributes:
        shards: The slabs of each shard.
    """

    name = "shared memory"
    shards: list[LaneShard]

    def __init__(
        self,
        relay: Lane,
        layouts: Sequence[slabs.Layout],
        slots: Sequence[SlotRing],
        attachment: Attachment,
    ) -> None:
        super().__init__(relay)
        self.slots = list(slots)
        pairs = zip(layouts, slots, strict=True)
        self.shards = [LaneShard(layout, ring.fd) for layout, ring in pairs]
        self._attachment = attachment
        self._watch = attachment.watch
        self._asked = BY_SERVER  # the operation whose answer the slabs get, or this
        results, manifest = self.declared, self.declared.manifest
        # the other workers of the same environment may be on this machine
        workers = -(-manifest.num_envs // results.count)
        cores = len(own_cpus())
        # with more shards than cores, one that waits awake takes its core from others
        may_spin = _ORDERED_STORES and workers < cores and len(self.shards) <= cores
        self._spin = self._step_spin = SpinChooser(may_spin)  # ``_spin``: that of the last request
        self._talk_spin = SpinChooser(may_spin)  # messages take longer than steps
        self._checked: list[Any] | None = None  # fields of a step that needs no check
        self._wishes: list[Wishes] = [(0, 0, 0)] * len(self.shards)  # for the next step
        self._listens = False  # whether the runners ring although nobody waits: ``sources``
        # One core is the client's. Shards without a core of their own (the sleepers) sleep until a
        # request comes, then run on the client's core while it sleeps. So the client sleeps for
        # the sleepers first, and then waits awake for the others (the wakers).
        self._cores = Cores(len(self.shards))
        self._awake = self._cores.awake
        self._sleepers = self.shards[self._awake :]
        self._wakers = self.shards[: self._awake]

    # --- attaching -----------------------------------------------------------------------------

    @classmethod
    def open(
        cls, relay: Lane, attach: Callable[[], Attachment], deadline: Deadline, *, slots: int
    ) -> SharedMemoryLane | None:
        """Make a lane with new slabs; None if they would be too large, or a runner refuses.
        ``slots``: the number of slots for batches; with one, each batch is copied out, with
        several, the caller borrows the slots.
        Raises ``WorkerError``: A runner died, or took too long.
        """
        layouts = message_layouts(relay.declared, slots)
        if layouts is None:
            return None
        rings = [SlotRing(slots, size, slots * size) for _, size in layouts]
        return cls(relay, [layout for layout, _ in layouts], rings, attach()).agreed(deadline)

    def agreed(self, deadline: Deadline) -> SharedMemoryLane | None:
        """Attach the runners; returns the lane, or closes it and returns None if one refuses."""
        agreed = False
        try:
            agreed = self._attach(range(len(self.shards)), deadline)
        finally:
            if not agreed:
                self.close()
        return self if agreed else None

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """Implements ``Lane.renew``; new runners get new slabs, which the dead ones never saw."""
        super().renew(dead, fresh, deadline)
        for index in dead:
            old = self.shards[index]
            self._attachment.forget(index, old)
            self.slots[index] = self._fresh_slots(index)
            self.shards[index] = LaneShard(old.layout, self.slots[index].fd)
            old.close()
        self._sleepers = self.shards[self._awake :]
        self._wakers = self.shards[: self._awake]
        if not self._attach(dead, deadline):
            raise RemoteProtocolError("a new runner refuses the shared memory of the others")

    def _attach(self, shards: Sequence[int], deadline: Deadline) -> bool:
        """Have the runners of some shards serve their slabs; returns whether all do."""
        # The order matters:
        #
        # 1. Each shard's descriptors are deposited with the server, since ZeroMQ cannot carry
        #    descriptors. The server answers with a pidfd: from then on the watch notices a death,
        #    and ``hand_over`` closes the client's copies of the descriptors.
        # 2. One ``Relay`` goes to all runners. The server adds each runner's deposit to its
        #    ``Attach``, so no runner sees the message without the descriptors. If a runner dies
        #    before that, the ``Relay`` fails; the server closes a deposit that is left over
        #    together with the jail (``FdStore.drop``).
        # 3. Only when every runner has answered, requests may go through the slabs: if one
        #    runner refuses, all of them use the other lane.
        #
        # The server keeps one deposit for each runner, and another environment may attach the same
        # runner. So ``attaching`` is held from the first deposit to the last answer.
        messages: list[tuple[int, m.Message]] = []
        with self.jail.attaching:
            for index in shards:
                try:
                    self._attachment.hand_over(
                        index, self.runners[index], self.shards[index], deadline
                    )
                except WorkerDiedError as error:  # the server knows why
                    raise self.jail.cause_of_death("make_env") from error
                messages.append((self.runners[index], self._attach_message(index)))
            replies = self.jail.exchange("attach", messages, deadline, deposited=True)
        return all(typed_reply(reply, m.Value).value is True for reply in replies)

    def _attach_message(self, index: int) -> m.Attach:
        return m.Attach(self.number, 0, 0, self.slots[index].count)

    def _fresh_slots(self, index: int) -> SlotRing:
        old = self.slots[index]
        old.close()
        return SlotRing(old.count, old.slot_bytes, old.count * old.slot_bytes)

    # --- messages ------------------------------------------------------------------------------

    @property
    def takes_more(self) -> bool:
        """Always False: each shard's slabs have room for one request and one answer."""
        return False

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """Implements ``Lane.send_step``."""
        [shard, *others], ring = self.shards, self.slots[0]
        if not others and self._asked == STEP:  # the usual case: the last request was a step
            self._asked_ns = perf_counter_ns()
            self._spin = self._step_spin
            ring.choose()
            if shard.write_actions(actions, self._wishes[0], ring):
                shard.announce()
                self._plan(0)  # the shard computes meanwhile, so nobody waits for this
                return
        super().send_step(actions, ahead=ahead)
        if not others and self._asked == STEP:
            shard.note_actions(actions)

    def _plan(self, slot: int) -> None:
        """Plan where the shards write a batch, and how they wait for the request after it."""
        spin_ns = self._step_spin.budget_ns
        cpus = self._cores.of_shards(spin_ns > 0)
        self._wishes = [
            (slot, spin_ns if index < self._awake else 0, cpu) for index, cpu in enumerate(cpus)
        ]

    def _send_to_all(
        self, operation: str, packed: Sequence[Frames], *, ahead: bool = False
    ) -> None:
        shards = zip(self.shards, packed, strict=True)
        if operation in _BULKY or not all(shard.has_room(frames) for shard, frames in shards):
            self._asked = BY_SERVER
            if operation in _BATCHES:
                self.leave_slots()
            super()._send_to_all(operation, packed, ahead=ahead)
            return
        if operation != STEP:  # logging would slow down steps, which often do not come here
            MESSAGES.debug("> %s in shared memory", operation)
        self._asked = operation  # interruption.md, rule 1: before anything is sent
        self._asked_ns = perf_counter_ns()
        self._spin = self._step_spin if operation == STEP else self._talk_spin
        cpus = self._cores.of_shards(self._spin.budget_ns > 0)
        for index, (shard, frames) in enumerate(zip(self.shards, packed, strict=True)):
            slot, ring = self._slot_for(operation, index)
            spin_ns = self._spin.budget_ns if index < self._awake else 0
            shard.write_message(frames, (slot, spin_ns, cpus[index]), ring)
            shard.announce()

    def _slot_for(self, operation: str, index: int) -> tuple[int, SlotRing | None]:
        """The slot for a shard's columns, and the ring whose chosen slot gets its answer.

        No caller may hold the slot that is written.
        """
        ring = self.slots[index] if operation in _BATCHES else None
        if ring is not None:
            ring.choose()
        return 0, ring

    def wait(self, deadline: Deadline) -> None:
        """Implements ``Lane.wait``."""
        self._checked = None  # an interrupted step may have left it
        if self._asked == BY_SERVER:
            super().wait(deadline)
            return
        deaths = self._wait_for_all(deadline)
        # the results of several shards have to be joined, so they are always checked
        if self._asked == STEP and not deaths and len(self.shards) == 1:
            self._checked = self.shards[0].checked_step()
        if self._checked is None:
            self._answers = self._replies(deaths, deadline)

    def result(self) -> StepResult:
        """Implements ``Lane.result``; a form that was checked before is not checked again."""
        checked, self._checked = self._checked, None
        if checked is not None:
            observation, rewards, ended, cut, own = checked
            return observation, rewards, ended, cut, own
        done = super().result()
        if self._asked == STEP:
            self.shards[0].note_checked(self.declared.restores)
        return done

    def leave_slots(self) -> None:
        """Implements ``Lane.leave_slots``."""
        for ring in self.slots:
            ring.leave()

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """Implements ``Lane.replies``."""
        if self._asked == BY_SERVER:
            return super().replies(deadline)
        return self._replies(self._wait_for_all(deadline), deadline)

    def _replies(self, deaths: dict[int, WorkerDiedError], deadline: Deadline) -> list[m.Message]:
        operation = self._asked
        living = [index for index in range(len(self.shards)) if index not in deaths]
        limits, space = self.jail.limits, self.declared.manifest.single_observation_space
        answers = {index: self.shards[index].answer(limits, space) for index in living}
        missing = [index for index, answer in answers.items() if answer is None]
        answers.update(self._fetched(missing, deaths, deadline))
        if operation != STEP:
            MESSAGES.debug("< %s in shared memory", operation)
        replies = self._as_messages([answers.get(index) for index in range(len(self.shards))])
        if deaths:
            raise RunnersDiedError(replies, deaths)
        return [reply for reply in replies if reply is not None]

    def _as_messages(self, answers: list[m.Message | None]) -> list[m.Message | None]:
        """The answers to a message, as the server would send them; None for dead runners."""
        return answers

    @property
    def _by_server(self) -> bool:
        return self._asked == BY_SERVER

    def _incomplete(self) -> list[int] | None:
        if not all(shard.answered() for shard in self.shards):
            return None
        self._listen(False)
        return [i for i, shard in enumerate(self.shards) if shard.has_more_elsewhere()]

    def _has_ended(self) -> bool:
        return self._listens and self._watch.wait(0)

    def sources(self) -> list[Source]:
        """Implements ``Lane.sources``."""
        if self._asked == BY_SERVER or self._fetching[0] == self._asked_ns:
            return super().sources()
        if not self._listens:
            self._listen(True)
        return [self._watch.fileno()]

    def _listen(self, wanted: bool) -> None:
        self._listens = wanted
        for shard in self.shards:
            shard.listen(wanted)

    def catch_up(self, deadline: Deadline) -> None:
        """Implements ``Lane.catch_up``."""
        super().catch_up(deadline)
        if self._asked != BY_SERVER:
            self._drop(self._wait_for_all(deadline))

    def _drop(self, deaths: dict[int, WorkerDiedError]) -> None:
        """Drop the answers unread: after an interrupt the slabs may hold older ones."""
        if deaths:
            raise RunnersDiedError([None] * len(self.shards), deaths)

    # --- waiting -------------------------------------------------------------------------------

    def _wait_for_all(self, deadline: Deadline) -> dict[int, WorkerDiedError]:
        """Wait until every shard has answered; returns the runners of a kept jail that died before.
        Raises ``WorkerTimeoutError``: the deadline came first; ``WorkerDiedError``: the jail has
        ended.
        """
        # The order matters:
        #
        # 1. We sleep for the sleepers, which share our core and cannot run before we sleep. The
        #    others compute on their own cores meanwhile.
        # 2. We wait awake for the others, within one budget for all of them, since a sleep and a
        #    wake-up cost more than most steps. For a shard that is later than that we sleep.
        #
        # Each wait looks at its shard's answer before it looks at a death: a runner that answers
        # and then dies has answered. All shards are waited for, also after one has raised: an
        # answer left in its slab would be taken for the answer to the next request
        # (interruption.md, rule 1). Waiting removes no answer, so after an interrupt ``_asked`` is
        # unchanged and ``catch_up`` waits for the same answers again. If ``answered`` has found
        # all answers (``_settled_ns``), there is no wait: a hostile jail could take its answer
        # back and delay the other workers.
        if self._settled_ns != self._asked_ns and not self._all_answer(deadline):
            return self._deaths(deadline)
        self.elapsed_ns = perf_counter_ns() - self._asked_ns
        self._spin.measured(self.elapsed_ns)
        return {}

    def _all_answer(self, deadline: Deadline) -> bool:
        """Wait for every shard; returns False if a process ended before all had answered."""
        for shard in self._sleepers:
            if not shard.answered_before_death(self._watch, deadline):
                return False
        budget_ns = self._spin.budget_ns
        until_ns = perf_counter_ns() + budget_ns
        for shard in self._wakers:
            if not budget_ns or not shard.answered_until(until_ns):
                if budget_ns:
                    self._spin.missed()
                    self._cores.look_again()
                if not shard.answered_before_death(self._watch, deadline):
                    return False
        return True

    def _deaths(self, deadline: Deadline) -> dict[int, WorkerDiedError]:
        """The deaths after a runner, its jail or the server has ended; the server knows why."""
        if not self.jail.kept:
            raise self.jail.cause_of_death(self._asked)
        answers = self._attachment.answers
        dead = [i for i, shard in enumerate(self.shards) if not answers(i, shard, deadline)]
        if not dead:  # all had answered before the death
            return {}
        try:  # the server knows how they died, at the latest when it has reaped them
            self._ask_for(dead)
            Lane.replies(self, Deadline(_CAUSE_S))
        except RunnersDiedError as error:
            return {dead[place]: death for place, death in error.deaths.items()}
        raise RemoteProtocolError("the worker reports a dead process as alive")

    # --- the rest ------------------------------------------------------------------------------

    def traffic(self) -> tuple[int, int, int]:
        """Implements ``Lane.traffic``."""
        stale, sent, received = super().traffic()
        sent += sum(shard.told_bytes for shard in self.shards)
        return stale, sent, received + sum(shard.answer_bytes for shard in self.shards)

    def close(self) -> None:
        """Implements ``Lane.close``: closes the slabs, doorbells and slots."""
        for shard in self.shards:
            shard.close()
        self._attachment.close()
        for ring in self.slots:
            ring.close()

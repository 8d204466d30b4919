"""The fast lane: messages over shared memory, straight to the jail's runners; steps are messages.

What does not fit goes over the server, as on the lane that it derives from. ``ColumnLane`` derives
from this one, and steps without messages.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.system.log import MESSAGES
from envhub_sandbox.transport.connection import Source
from envhub_sandbox.transport.deadline import Cores, Deadline, SpinChooser, own_cpus
from envhub_sandbox.transport.jail import Frames
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError, typed_reply
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.attachment import Attachment
from envhub_sandbox.transport.shared_memory.client_slabs import (
    LaneShard,
    SlotRing,
    message_layouts,
)
from envhub_sandbox.transport.shared_memory.slab_lane import STEP, SlabLane
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs

# elsewhere a core may see the sequence word before the data it announces: sleep, do not poll
_ORDERED_STORES = platform.machine() in ("x86_64", "AMD64")
BY_SERVER = ""
"""In place of an operation's name, where it is the relay that is owed the answer."""
_BULKY = frozenset({"render"})
"""What hardly ever fits the slabs."""
_BATCHES = frozenset({STEP, "reset"})
"""Operations that return a batch of observations, which goes into a slot."""
_CAUSE_S = 10.0
"""For how long the server may take to say how a runner has died."""


class SharedMemoryLane(SlabLane):
    """Slabs and doorbells, over all shards of one environment: see ``Lane``.

    Args:
        relay: A lane to the same runners.
        layouts: Where each shard's actions and messages lie.
        slots: Of each shard, where the answers to steps lie.
        attachment: The other ends of the slabs.

    Attributes:
        shards, slots: As given.
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
        self._asked = BY_SERVER
        results, manifest = self.declared, self.declared.manifest
        # as many workers of the same environment are on this machine, or may be
        workers = -(-manifest.num_envs // results.count)
        may_spin = _ORDERED_STORES and workers < len(own_cpus())
        self._spin = self._step_spin = SpinChooser(may_spin)
        self._talk_spin = SpinChooser(may_spin)  # messages take another time than steps
        self._checked: list[Any] | None = None  # a step that needs no further check
        self._listens = False
        # One core is the client's. Shards that find no other sleep until they are asked, then run
        # on the client's while it sleeps: so it waits for those first, and for the others awake.
        self._cores = Cores(len(self.shards))
        self._awake = self._cores.awake
        self._sleepers = self.shards[self._awake :]
        self._wakers = self.shards[: self._awake]

    # --- agreed on -----------------------------------------------------------------------------

    @classmethod
    def open(
        cls, relay: Lane, attach: Callable[[], Attachment], deadline: Deadline, *, slots: int
    ) -> SharedMemoryLane | None:
        """A lane with fresh slabs; None where they would be too large, or a runner refuses.
        ``slots``: how many batches there is room for; one is copied out, of several each is handed
        out where it lies.

        Raises:
            WorkerError: A runner died, or took too long.
        """
        layouts = message_layouts(relay.declared, slots)
        if layouts is None:
            return None
        rings = [SlotRing(slots, size, slots * size) for _, size in layouts]
        return cls(relay, [layout for layout, _ in layouts], rings, attach()).agreed(deadline)

    def agreed(self, deadline: Deadline) -> SharedMemoryLane | None:
        """The lane, if all runners attach the slabs; else it is closed."""
        agreed = False
        try:
            agreed = self._attach(range(len(self.shards)), deadline)
        finally:
            if not agreed:
                self.close()
        return self if agreed else None

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """See ``Lane``; they get slabs that the dead never saw."""
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
            raise RemoteProtocolError("a fresh runner refuses the fast lane that others take")

    def _attach(self, shards: Sequence[int], deadline: Deadline) -> bool:
        """Have the runners of some shards serve these slabs; whether all of them do."""
        # In this order. ZeroMQ carries no descriptors: so each shard's are deposited with the
        # server first, which answers with a pidfd. From then on a death is noticed by the watch,
        # and the client's copies of the descriptors are closed (``hand_over``). Then one ``Relay``
        # goes to all runners, and takes each one's deposit along with its ``Attach``: no runner can
        # see the message without the descriptors. Who dies in between is an error of the ``Relay``;
        # what then still waits in the server is closed there with the jail (``FdStore.drop``).
        # Nothing goes through the slabs before every runner has answered, for one that refuses
        # makes all of them use the other lane.
        # The server keeps one deposit for each runner, which another environment may have as well.
        messages: list[tuple[int, m.Message]] = []
        with self.jail.attaching:
            for index in shards:
                self._hand_over(index, deadline)
                messages.append((self.runners[index], self._attach_message(index)))
            replies = self.jail.exchange("attach", messages, deadline, deposited=True)
        return all(typed_reply(reply, m.Value).value is True for reply in replies)

    def _hand_over(self, index: int, deadline: Deadline) -> None:
        try:
            self._attachment.hand_over(index, self.runners[index], self.shards[index], deadline)
        except WorkerDiedError as error:  # why, the server knows
            raise self.jail.cause_of_death("make_env") from error

    def _attach_message(self, index: int) -> m.Attach:
        return m.Attach(self.number, 0, 0, self.slots[index].count)

    def _fresh_slots(self, index: int) -> SlotRing:
        old = self.slots[index]
        old.close()
        return SlotRing(old.count, old.slot_bytes, old.count * old.slot_bytes)

    # --- messages ------------------------------------------------------------------------------

    @property
    def takes_more(self) -> bool:
        """See ``Lane``: there is one slab for what is asked, and one for what is answered."""
        return False

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """See ``Lane``."""
        [shard, *others], ring = self.shards, self.slots[0]
        if not others and self._asked == STEP:  # as the last time, which it usually is
            self._asked_ns = perf_counter_ns()
            self._spin = self._step_spin
            ring.choose()
            if shard.write_actions(actions, (0, self._spin.budget_ns, 0), ring):
                shard.announce()
                return
        super().send_step(actions, ahead=ahead)
        if not others and self._asked == STEP:
            shard.note_actions(actions)

    def _send_to_all(
        self, operation: str, packed: Sequence[Frames], *, ahead: bool = False
    ) -> None:
        if not self._goes_by_slabs(operation, packed):
            self._asked = BY_SERVER
            if operation in _BATCHES:
                self.leave_slots()
            super()._send_to_all(operation, packed, ahead=ahead)
            return
        if operation != STEP:  # which has to cost nothing, and is often sent without this
            MESSAGES.debug("> %s in shared memory", operation)
        self._asked = operation  # interruption.md, rule 1: first
        self._asked_ns = perf_counter_ns()
        self._spin = self._step_spin if operation == STEP else self._talk_spin
        # one shard alone is left to the kernel
        cpus = self._cores.of_shards() if len(self.shards) > 1 else [0]
        for index, (shard, frames) in enumerate(zip(self.shards, packed, strict=True)):
            slot, ring = self._slot_for(operation, index)
            spin_ns = self._spin.budget_ns if index < self._awake else 0
            shard.write_message(frames, (slot, spin_ns, cpus[index]), ring)
            shard.announce()

    def _goes_by_slabs(self, operation: str, packed: Sequence[Frames]) -> bool:
        if operation in _BULKY:
            return False
        pairs = zip(self.shards, packed, strict=True)
        return all(shard.has_room(frames) for shard, frames in pairs)

    def _slot_for(self, operation: str, index: int) -> tuple[int, SlotRing | None]:
        """The slot that a shard's columns go to, and the ring with that for its answer.

        What is written must not be held by anyone.
        """
        ring = self.slots[index] if operation in _BATCHES else None
        if ring is not None:
            ring.choose()
        return 0, ring

    def wait(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        self._checked = None  # that of a step that was interrupted
        if self._asked == BY_SERVER:
            super().wait(deadline)
            return
        deaths = self._wait_for_all(deadline)
        # of several shards, results are always looked into
        if self._asked == STEP and not deaths and not self.declared.looks_inside:
            self._checked = self.shards[0].checked_step()
        if self._checked is None:
            self._answers = self._replies(deaths, deadline)

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """See ``Lane``. Results of a form that has been checked before are not checked again."""
        checked, self._checked = self._checked, None
        if checked is not None and infos is None:
            observation, rewards, ended, cut, own = checked
            return observation, rewards, ended, cut, own
        done = super().result(infos)
        if self._asked == STEP:
            self.shards[0].note_checked()
        return done

    def leave_slots(self) -> None:
        """See ``Lane``."""
        for ring in self.slots:
            ring.leave()

    def send_for_infos(self, *, failed: bool = False) -> None:
        """See ``Lane``."""
        self._asked = BY_SERVER
        super().send_for_infos(failed=failed)

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """See ``Lane``."""
        if self._asked == BY_SERVER:
            return super().replies(deadline)
        return self._replies(self._wait_for_all(deadline), deadline)

    def _replies(self, deaths: dict[int, WorkerDiedError], deadline: Deadline) -> list[m.Message]:
        operation = self._asked
        living = [index for index in range(len(self.shards)) if index not in deaths]
        answers = {index: self.shards[index].answer(self.jail.limits) for index in living}
        missing = [index for index, answer in answers.items() if answer is None]
        answers.update(self._fetched(missing, deaths, deadline))
        if operation != STEP:
            MESSAGES.debug("< %s in shared memory", operation)
        replies = self._as_messages([answers.get(index) for index in range(len(self.shards))])
        if deaths:
            raise RunnersDiedError(replies, deaths)
        return [reply for reply in replies if reply is not None]

    def _as_messages(self, answers: list[m.Message | None]) -> list[m.Message | None]:
        """The answers to a message as they would have come through the server; None of the dead."""
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
        """See ``Lane``."""
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
        """See ``Lane``."""
        super().catch_up(deadline)
        if self._asked != BY_SERVER:
            self._drop(self._wait_for_all(deadline))

    def _drop(self, deaths: dict[int, WorkerDiedError]) -> None:
        """Take no answer: where one lies was chosen, but perhaps the request never sent."""
        if deaths:
            raise RunnersDiedError([None] * len(self.shards), deaths)

    # --- waiting -------------------------------------------------------------------------------

    def _wait_for_all(self, deadline: Deadline) -> dict[int, WorkerDiedError]:
        """Until every shard has answered; returns which runners of a kept jail have died before.

        Raises:
            WorkerTimeoutError: The deadline came first.
            WorkerDiedError: The jail has ended.
        """
        # In this order. The sleepers, who share this core, cannot run before we sleep: so we sleep
        # for them first, at once, while the others compute on their own cores. What these have
        # taken by then costs nothing more. Only then do we wait awake for the others, within one
        # budget for all of them, since a sleep and a wake-up cost more than most steps; for who is
        # later than that we sleep as well. Each wait looks at its shard's answer before it looks at
        # a death: a runner that answers and then dies has answered. All shards are waited for, also
        # after one has raised: an answer that is left in its slab would be taken for the answer to
        # the next request (interruption.md, rule 1). An interrupt anywhere here leaves ``_asked``
        # as it was, and ``catch_up`` waits for the same answers again: to wait takes nothing away.
        # What ``answered`` has found is not waited for: a jail may take it back, and others would
        # wait for it as well.
        if self._settled_ns != self._asked_ns and not self._all_answer(deadline):
            return self._deaths(deadline)
        self.elapsed_ns = perf_counter_ns() - self._asked_ns
        self._spin.measured(self.elapsed_ns)
        return {}

    def _all_answer(self, deadline: Deadline) -> bool:
        """Wait for every shard; whether they have answered before one of the runners ended."""
        for shard in self._sleepers:
            if not shard.answered_before_death(self._watch, deadline):
                return False
        budget_ns = self._spin.budget_ns
        until_ns = perf_counter_ns() + budget_ns
        for shard in self._wakers:
            if not budget_ns or not shard.answered_until(until_ns):
                if budget_ns:
                    self._spin.missed()
                if not shard.answered_before_death(self._watch, deadline):
                    return False
        return True

    def _deaths(self, deadline: Deadline) -> dict[int, WorkerDiedError]:
        """A runner has ended, or its jail, or the server; that one knows why, if it lives."""
        if not self.jail.kept:
            raise self.jail.cause_of_death(self._asked)
        answers = self._attachment.answers
        dead = [i for i, shard in enumerate(self.shards) if not answers(i, shard, deadline)]
        if not dead:  # they had answered before
            return {}
        try:  # how, the server knows at the latest when they have been reaped
            self._ask_for(dead)
            Lane.replies(self, Deadline(_CAUSE_S))
        except RunnersDiedError as error:
            return {dead[place]: death for place, death in error.deaths.items()}
        raise RemoteProtocolError("the worker says that a process lives which has died")

    # --- the rest ------------------------------------------------------------------------------

    def traffic(self) -> tuple[int, int, int]:
        """See ``Lane``."""
        stale, sent, received = super().traffic()
        sent += sum(shard.told_bytes for shard in self.shards)
        return stale, sent, received + sum(shard.answer_bytes for shard in self.shards)

    def close(self) -> None:
        """See ``Lane``."""
        for shard in self.shards:
            shard.close()
        self._attachment.close()
        for ring in self.slots:
            ring.close()

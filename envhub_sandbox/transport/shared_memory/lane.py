"""The fast lane: steps, and small messages, over shared memory, straight to the jail's runners.

A step costs one wake-up per shard and one copy out. What is large, what may have to be repeated in
a fresh runner, and infos that did not fit go over the server, as on the lane that it derives from.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, WorkerDiedError
from envhub_sandbox.system.log import MESSAGES
from envhub_sandbox.transport.connection import Source
from envhub_sandbox.transport.deadline import Cores, Deadline, SpinChooser, own_cpus
from envhub_sandbox.transport.jail import Frames, Request
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError, typed_reply
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.attachment import Attachment
from envhub_sandbox.transport.shared_memory.client_slabs import (
    RING,
    JoinedColumns,
    LaneShard,
    ObservationSlab,
    Outcome,
    action_layouts,
    by_shard,
    infos_of,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.stream import pack_packet

_CAUSE_S = 10.0
# elsewhere a core may see the sequence word before the data it announces: sleep, do not poll
_ORDERED_STORES = platform.machine() in ("x86_64", "AMD64")
_STEP = "step"
_BY_SERVER = ""
"""In place of an operation's name, where it is the relay that is owed the answer."""
_BULKY = frozenset({"render"})
"""What hardly ever fits the slabs."""
_FRAME_BYTES = 8
_ROOM = slabs.INFO_BYTES - 64
"""For the frames of a message, less what is put around them."""
_NOTHING: list[Outcome] = []


class _RunnerGoneError(Exception):
    """A runner has ended, or its jail, or the server; that one knows why, if it lives."""


class SharedMemoryLane(Lane):
    """Slabs and doorbells, over all shards of one environment: see ``Lane``.

    Args:
        relay: A lane to the same runners.
        observed: Where the observations lie.
        layouts: Where each shard's actions and infos lie.
        attachment: The other ends of the slabs.
    """

    name = "shared memory"

    def __init__(
        self,
        relay: Lane,
        observed: slabs.ObservationLayout,
        layouts: Sequence[slabs.Layout],
        attachment: Attachment,
    ) -> None:
        super().__init__(relay.jail, relay.runners, relay.number, relay.declared)
        results, manifest = relay.declared, relay.declared.manifest
        self.observations = ObservationSlab(manifest.single_observation_space, observed)
        self.shards = [self._shard(layout) for layout in layouts]
        self._attachment = attachment
        self._watch = attachment.watch
        self._bounds = results.slices
        self._action_space = manifest.single_action_space
        leaves = layouts[0].actions
        self._flat_actions = len(leaves) == 1 and not leaves[0].path
        self._asked = _BY_SERVER
        self._said = _NOTHING
        self._joined = JoinedColumns((), ())
        self._steps = 0
        self._step_bytes = sum(one.action_bytes for one in layouts), observed.batch_bytes
        # as many workers of the same environment are on this machine, or may be
        workers = -(-manifest.num_envs // results.count)
        may_spin = _ORDERED_STORES and workers < len(own_cpus())
        self._spin = self._step_spin = SpinChooser(may_spin)
        self._talk_spin = SpinChooser(may_spin)  # messages take another time than steps
        self._fetching: tuple[int, Sequence[int]] = 0, ()  # for which request, of which shards
        self._settled_ns = 0  # the request of which ``answered`` has found all answers
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
        cls, relay: Lane, attachment: Attachment, deadline: Deadline, *, copy: bool
    ) -> SharedMemoryLane | None:
        """A lane with fresh slabs; None where the spaces have no fixed layout, or a runner refuses.

        Raises:
            WorkerError: A runner died, or took too long.
        """
        results, slots = relay.declared, 1 if copy else 1 + RING
        space = results.manifest.single_observation_space
        observed = slabs.observation_layout(space, results.count, slots)
        layouts = action_layouts(results)
        if observed is None or layouts is None:
            attachment.close()
            return None
        lane = cls(relay, observed, layouts, attachment)
        agreed = False
        try:
            agreed = lane._attach(range(len(layouts)), deadline)
        finally:
            if not agreed:
                lane.close()
        return lane if agreed else None

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """See ``Lane``; they get slabs that the dead never saw."""
        super().renew(dead, fresh, deadline)
        for index in dead:
            old = self.shards[index]
            self._attachment.forget(index, old)
            self.shards[index] = self._shard(old.layout)
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
        layout, bounds = self.observations.layout, self._bounds
        messages: list[tuple[int, m.Message]] = []
        for index in shards:
            try:
                self._attachment.hand_over(index, self.runners[index], self.shards[index], deadline)
            except WorkerDiedError as error:  # why, the server knows
                raise self.jail.cause_of_death("make_env") from error
            attach = m.Attach(self.number, bounds[index][0], layout.count, layout.slots)
            messages.append((self.runners[index], attach))
        replies = self.jail.exchange("attach", messages, deadline, deposited=True)
        return all(typed_reply(reply, m.Value).value is True for reply in replies)

    # --- steps ---------------------------------------------------------------------------------

    def _shard(self, layout: slabs.Layout) -> LaneShard:
        return LaneShard(layout, self.observations.fd)

    @property
    def takes_more(self) -> bool:
        """See ``Lane``: there is one slab for what is asked, and one for what is answered."""
        return False

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """See ``Lane``."""
        self._asked = _STEP  # interruption.md, rule 1: first
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
        except _RunnerGoneError:
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

    def _fetch(self, shards: Sequence[int], deadline: Deadline) -> list[m.Message]:
        """What some shards' runners could not put into their slabs."""
        if self._fetching != (self._asked_ns, shards):  # else ``answered`` has asked for it
            self._ask_for(shards)
        self._fetching = 0, ()
        return super().replies(deadline)

    def _ask_for(self, shards: Sequence[int]) -> None:
        packed = [self.jail.pack(m.FetchInfos(self.number))] * len(shards)
        super().send_some(self._asked, [self.runners[index] for index in shards], packed)

    # --- messages ------------------------------------------------------------------------------

    def send(self, request: Request) -> None:
        """See ``Lane``."""
        operation = request.operation
        # what may have to be repeated in a fresh runner goes by the server, who knows the dead
        if self.jail.kept or operation in _BULKY or not all(map(_fits, request.frames)):
            self._asked = _BY_SERVER
            if operation == "reset":
                self.observations.leave()
            super().send(request)
            return
        MESSAGES.debug("> %s in shared memory", operation)
        self._asked = operation  # interruption.md, rule 1: first
        self._asked_ns = perf_counter_ns()
        self._spin = self._talk_spin
        # a reset writes a batch, and what is written must not be held by anyone
        choose = operation == "reset"
        slot = self.observations.choose() if choose else self.observations.chosen
        # one shard alone is left to the kernel
        cpus = self._cores.of_shards() if len(self.shards) > 1 else [0]
        for index, (shard, frames) in enumerate(zip(self.shards, request.frames, strict=True)):
            spin_ns = self._spin.budget_ns if index < self._awake else 0
            shard.tell(b"".join(pack_packet(0, frames)), (slot, spin_ns, cpus[index]))

    def leave_slots(self) -> None:
        """See ``Lane``."""
        self.observations.leave()

    def send_for_infos(self, *, failed: bool = False) -> None:
        """See ``Lane``."""
        self._asked = _BY_SERVER
        super().send_for_infos(failed=failed)

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """See ``Lane``."""
        operation = self._asked
        if operation == _BY_SERVER:
            return super().replies(deadline)
        try:
            self._wait_for_all(deadline)
        except _RunnerGoneError:
            raise self.jail.cause_of_death(self._asked) from None
        answers = [shard.answer() for shard in self.shards]
        missing = [index for index, answer in enumerate(answers) if answer is None]
        if missing:
            self._refuse_further(missing)
            for index, reply in zip(missing, self._fetch(missing, deadline), strict=True):
                answers[index] = reply
        MESSAGES.debug("< %s in shared memory", operation)
        replies = [answer for answer in answers if answer is not None]
        return self._with_observations(replies) if operation == "reset" else replies

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

    def answered(self) -> bool:
        """See ``Lane``. What has to be fetched is asked for here: a runner may never give it."""
        if self._asked == _BY_SERVER:
            return super().answered()
        if self._settled_ns == self._asked_ns:
            return True
        for shard in self.shards:
            if not shard.answered():
                return self._listens and self._watch.wait(0)
        if self._fetching[0] != self._asked_ns:
            self._listen(False)
            shards = [i for i, shard in enumerate(self.shards) if shard.has_more_elsewhere()]
            try:
                if shards:
                    self._ask_for(shards)
            except EnvHubError:  # whoever waits asks again, and meets the same
                return True
            self._fetching = self._asked_ns, shards
        if self._fetching[1] and not super().answered():
            return False
        self._settled_ns = self._asked_ns
        return True

    def sources(self) -> list[Source]:
        """See ``Lane``."""
        if self._asked == _BY_SERVER or self._fetching[0] == self._asked_ns:
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
        # with what ``answered`` has asked for besides: it is asked for anew
        self._settled_ns, self._fetching = 0, (0, ())
        if self._asked == _STEP:
            self._outcomes(deadline)  # wanted or not: later columns are of the schema they bring
        elif self._asked != _BY_SERVER:
            self.replies(deadline)

    # --- waiting -------------------------------------------------------------------------------

    def _wait_for_all(self, deadline: Deadline) -> None:
        """Until every shard has answered.

        Raises:
            WorkerTimeoutError: The deadline came first.
            _RunnerGoneError: A runner ended first.
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
        if self._settled_ns != self._asked_ns:
            self._wait_for_each(deadline)
        self.elapsed_ns = perf_counter_ns() - self._asked_ns
        self._spin.measured(self.elapsed_ns)

    def _wait_for_each(self, deadline: Deadline) -> None:
        for shard in self._sleepers:
            if not shard.answered_before_death(self._watch, deadline):
                raise _RunnerGoneError
        budget_ns = self._spin.budget_ns
        until_ns = perf_counter_ns() + budget_ns
        for shard in self._wakers:
            if not budget_ns or not shard.answered_until(until_ns):
                if budget_ns:
                    self._spin.missed()
                if not shard.answered_before_death(self._watch, deadline):
                    raise _RunnerGoneError

    def _refuse_further(self, missing: Sequence[int]) -> None:
        """Refuse an answer that says after ``answered`` that more has to be fetched.

        Trust: input from the worker, which may never give that; others wait meanwhile.
        """
        if self._settled_ns == self._asked_ns and self._fetching != (self._asked_ns, missing):
            raise RemoteProtocolError("the worker has changed an answer that was there already")

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

    # --- the rest ------------------------------------------------------------------------------

    def traffic(self) -> tuple[int, int, int]:
        """See ``Lane``; of what lies in shared memory, infos and messages are left out."""
        stale, sent, received = super().traffic()
        there, back = self._step_bytes
        return stale, sent + there * self._steps, received + back * self._steps

    def close(self) -> None:
        """See ``Lane``."""
        for shard in self.shards:
            shard.close()
        self._attachment.close()
        self.observations.close()


def _fits(frames: Frames) -> bool:
    """Whether the frames of a message fit a slab."""
    return sum(memoryview(frame).nbytes + _FRAME_BYTES for frame in frames) < _ROOM

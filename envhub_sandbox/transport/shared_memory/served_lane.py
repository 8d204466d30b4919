"""Steps through slabs that the server shares with the runners, for a client that cannot.

It is on another host, or the caller has chosen frames. A step is one message each way: the client's
half of each shard's request slab, and what the runner wrote into the reply and the observations.
All else goes as over ``Lane``, and so do steps of which several are on their way: a slab has
room for one.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline, SpinChooser
from envhub_sandbox.transport.jail import Frames
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError, expect_reply, typed_reply
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.client_slabs import (
    ObservationSlab,
    Outcome,
    ShardSlabs,
    action_layouts,
    by_shard,
    infos_of,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.limits import LARGE_BYTES
from envhub_worker.protocol.shared_memory import slabs

_HEAD = struct.Struct("<QQ")
_HEAD_AT = slabs.OUTCOME * 8
_PLAIN = _HEAD.pack(slabs.DONE, 0)
"""Results and nothing else."""
_NO_MORE: Outcome = (slabs.DONE, None)
"""The same, read."""


class ServedLane(Lane):
    """See ``Lane``.

    Args:
        relay: The way over the server, to the same runners.
        shards: The slabs of each.
    """

    def __init__(self, relay: Lane, shards: list[ServedShard]) -> None:
        super().__init__(relay.jail, relay.runners, relay.number, relay.declared)
        self._shards = shards
        self._action_space = self.declared.manifest.single_action_space
        leaves = shards[0].slabs.layout.actions
        self._flat_actions = len(leaves) == 1 and not leaves[0].path
        self._spin = SpinChooser(True)
        self._by_message = self._more_wanted = self._by_slabs = False
        self._outcomes: list[Outcome] = []
        self._asked: Sequence[int] = ()  # shards, for infos that did not fit

    @classmethod
    def open(cls, relay: Lane, deadline: Deadline) -> Lane:
        """The lane; ``relay`` itself where the spaces have no fixed layout, or one side refuses.

        Raises:
            WorkerError: A runner died, or took too long.
        """
        results = relay.declared
        space = results.manifest.single_observation_space
        shards = [
            ServedShard(space, layout, observed)
            for layout in action_layouts(results) or ()
            if (observed := slabs.observation_layout(space, layout.count, 1)) is not None
        ]
        if len(shards) < len(results.slices):
            return relay
        lane = cls(relay, shards)
        return lane if lane._attach(range(len(shards)), deadline) else relay

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """See ``Lane``; they get slabs that the dead never saw."""
        super().renew(dead, fresh, deadline)
        for index in dead:
            self._shards[index] = self._shards[index].again()
        if not self._attach(dead, deadline, again=True):
            raise RemoteProtocolError("a fresh runner refuses the slabs that others take")

    def _attach(self, shards: Sequence[int], deadline: Deadline, *, again: bool = False) -> bool:
        """Have the server make slabs and the runners serve them; whether all of them do.
        ``again``: others have; a refusal of the server's is raised.
        """
        runners, wanted = self.runners, [(index, self._shards[index]) for index in shards]
        sizes = tuple((runners[index], *shard.sizes) for index, shard in wanted)
        if not all(slabs.served(*one[1:], self.jail.limits.message_bytes) for one in sizes):
            return False
        request = m.ShareSlabs(self.jail.number, sizes)
        reply, _ = self.jail.client.request(request, deadline=deadline)
        if isinstance(reply, m.Refusal) and not again:  # its limits, or a quota, are lower
            return False
        expect_reply(reply, m.Done)
        parts = tuple((runner, 1) for runner in runners)
        self._step = m.Relay(self.jail.number, "step", parts, False, True)
        messages: list[tuple[int, m.Message]] = [
            (runners[index], m.Attach(self.number, 0, shard.count, 1)) for index, shard in wanted
        ]
        replies = self.jail.exchange("attach", messages, deadline, deposited=True)
        return all(typed_reply(reply, m.Value).value is True for reply in replies)

    @property
    def takes_more(self) -> bool:
        """See ``Lane``."""
        return self._by_message and super().takes_more

    def expect_more(self) -> None:
        """See ``Lane``."""
        self._more_wanted = True

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """See ``Lane``."""
        if not ahead:
            self._by_message, self._more_wanted = self._more_wanted, False
        if self._by_message and super().takes_more:
            super().send_step(actions, ahead=ahead)
            return
        self._asked_ns = perf_counter_ns()
        shards, spin_ns = self._shards, self._spin.budget_ns
        leaves = [actions] if self._flat_actions else slabs.flatten(self._action_space, actions)
        if len(shards) == 1:
            payload = [shards[0].ask(leaves, spin_ns)]
        else:
            rows = [[leaf[slice(*each)] for leaf in leaves] for each in self.declared.slices]
            payload = [shard.ask(own, spin_ns) for shard, own in zip(shards, rows, strict=True)]
        self._send(lambda: self.jail.send_relay(self._step, payload), self._outcome)

    def _outcome(self, index: int, frames: Frames) -> Outcome:
        """Trust: input from the worker, which may call an exception something else."""
        kind, message = self._shards[index].read(frames)
        return slabs.RAISED if isinstance(message, m.RaisedException) else kind, message

    def wait(self, deadline: Deadline) -> None:
        """See ``Lane``."""
        self._by_slabs = self._owed[0][2] is not None
        if not self._by_slabs:
            super().wait(deadline)
            return
        outcomes: list[Outcome | None]
        deaths: dict[int, WorkerDiedError] = {}
        try:
            outcomes = [*self.replies(deadline)]
        except RunnersDiedError as error:
            outcomes, deaths = error.replies, error.deaths
        self.elapsed_ns = perf_counter_ns() - self._asked_ns
        if 0 < self._spin.budget_ns < self.elapsed_ns:
            self._spin.missed()  # the runner has gone to sleep: count a missed spin
        self._spin.measured(self.elapsed_ns)
        # what one has raised comes before the infos of others, unless a recovery needs these, or
        # they were asked for: warnings come with them
        said = [one[1] for one in outcomes if one is not None]
        if deaths or self._owed or m.RaisedException not in map(type, said):
            self._fetch(outcomes, deaths, deadline)
        if deaths:
            raise RunnersDiedError(list(map(self._stepped, self._shards, outcomes)), deaths)
        self._outcomes = [one for one in outcomes if one is not None]

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """See ``Lane``. Trust: input from the worker."""
        if not self._by_slabs:
            return super().result(infos)
        shards, outcomes = self._shards, self._outcomes
        if infos is None:
            infos = {}
            if outcomes != [_NO_MORE] * len(shards):
                infos = self.declared.infos(list(map(self._infos_of, shards, outcomes)))
        parts = [(*shard.rows(), infos) for shard in shards]
        return parts[0] if len(parts) == 1 else self.declared.joined_steps(parts, infos)

    def _infos_of(self, shard: ServedShard, outcome: Outcome) -> dict[Any, Any]:
        return infos_of(shard.slabs, outcome, self.declared)

    def _stepped(self, shard: ServedShard, outcome: Outcome | None) -> m.Message | None:
        """What a shard that lives wrote, as the message that it stands for."""
        if outcome is None:
            return None
        if isinstance(outcome[1], m.RaisedException):
            return outcome[1]
        return m.StepDone(*shard.rows(), self._infos_of(shard, outcome))

    def _fetch(
        self, outcomes: list[Outcome | None], deaths: dict[int, WorkerDiedError], deadline: Deadline
    ) -> None:
        """Put infos in that did not fit the slabs. Who dies meanwhile is added to the deaths."""
        missing = [i for i, one in enumerate(outcomes) if one is not None and one[0] == slabs.FETCH]
        if not self._owed:  # else ``answered`` has asked for them
            if not missing:
                return
            self._ask_for(missing)
        fetched: Sequence[m.Message | None]
        try:
            fetched = self.replies(deadline)
        except RunnersDiedError as error:
            fetched = error.replies
            deaths.update(by_shard(error, self._asked))
        for index, reply in zip(self._asked, fetched, strict=True):
            if reply is None:
                outcomes[index] = None
            elif index in missing:
                outcomes[index] = slabs.DONE, reply

    def _ask_for(self, shards: Sequence[int], *, ahead: bool = False) -> None:
        self._asked = shards
        packed = [self.jail.pack(m.FetchInfos(self.number))] * len(shards)
        self.send_some("step", [self.runners[index] for index in shards], packed, ahead=ahead)

    def answered(self) -> bool:
        """See ``Lane``. What has to be fetched is asked for here: a runner may never give it."""
        if not super().answered():
            return False
        if not self._owed or self._owed[0][2] is None:
            return True
        if len(self._owed) == 1:
            lacking = self._lacking()
            try:
                if lacking:
                    self._ask_for(lacking, ahead=True)
            except EnvHubError:  # whoever waits asks again, and meets the same
                return True
        return len(self._owed) == 1 or self.jail.client.arrived(self._owed[1][0])

    def _lacking(self) -> list[int]:
        """The shards whose infos did not fit, in what has arrived. Trust: input from the worker."""
        parts = self.jail.arrived(self._owed[0][0])
        heads = [bytes(part[0][: _HEAD.size]) for part in parts]
        if not all(len(head) == _HEAD.size for head in heads):
            return []
        return [i for i, head in enumerate(heads) if _HEAD.unpack(head)[0] == slabs.FETCH]


class ServedShard:
    """Our half of the slabs of one shard, and what the server sent of the other.

    Attributes:
        count: Its sub-environments.
        slabs: The request slab and the reply slab.
        observations: Its own rows, and no others.
    """

    def __init__(
        self, space: gym.Space[Any], layout: slabs.Layout, observed: slabs.ObservationLayout
    ) -> None:
        self._space, self._layout, self._observed = space, layout, observed
        request = bytearray(layout.request_bytes)
        self._reply = memoryview(bytearray(slabs.REPLY_BYTES))
        self._received = memoryview(bytearray(observed.total_bytes))
        self._plain_bytes = _HEAD.size + observed.total_bytes
        leaves = len(layout.actions)
        self._words = memoryview(request)[slabs.OWN_BYTES : (slabs.DTYPES + leaves) * 8]
        self._actions = memoryview(request)[slabs.HEADER_BYTES : layout.message]
        self.slabs = ShardSlabs(layout, request, self._reply)
        self.observations = ObservationSlab(space, observed, self._received)
        self._assemble = slabs.assembler(space)
        self._pieces: list[Buffer] = []

    def again(self) -> ServedShard:
        """The same with nothing in it."""
        return ServedShard(self._space, self._layout, self._observed)

    @property
    def count(self) -> int:
        """Its sub-environments."""
        return self._layout.count

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Leaves of the actions, and bytes of the request slab and of the observation slab."""
        layout = self._layout
        return len(layout.actions), layout.request_bytes, self._observed.total_bytes

    def ask(self, leaves: Sequence[Any], spin_ns: int) -> bytes:
        """What the server writes into the request slab for a step."""
        self.slabs.write(leaves, (0, spin_ns, 0))
        return b"".join((self._words, self._actions))

    def read(self, frames: Frames) -> Outcome:
        """How a step went; the rest lies in the slabs. Trust: input from the worker."""
        first = memoryview(frames[0])
        if len(first) == self._plain_bytes and first[: _HEAD.size] == _PLAIN:
            self._received[:] = first[_HEAD.size :]
            self._pieces = []
            return _NO_MORE
        if len(first) < _HEAD.size:
            raise RemoteProtocolError("the worker sent less than the outcome of a step")
        kind, length = _HEAD.unpack_from(first)
        size = self.slabs.known if kind == slabs.COLUMNS else min(length, slabs.INFO_BYTES)
        self._reply[_HEAD_AT : _HEAD_AT + _HEAD.size] = first[: _HEAD.size]
        infos, rest = first[_HEAD.size : _HEAD.size + size], first[_HEAD.size + size :]
        pieces: list[Buffer] = [rest, *frames[1:]]
        if len(infos) < size or sum(map(len, pieces)) != len(self._received):
            raise RemoteProtocolError("the worker sent slabs of another size than was agreed on")
        self._reply[slabs.INFOS : slabs.INFOS + size] = infos
        # of a large batch, what has a place of its own is copied there, and once
        self._pieces = pieces if len(self._received) > LARGE_BYTES else []
        start = self._observed.results if self._pieces else 0
        _copy(pieces, start, self._received[start:])
        return self.slabs.outcome()

    def rows(self) -> tuple[Any, Any, Any, Any]:
        """Observation, rewards, terminations and truncations; the caller's own."""
        return self._observation(), *self.observations.results()

    def _observation(self) -> Any:
        pieces, self._pieces = self._pieces, []
        if not pieces:
            return self.observations.take()
        made = []
        for leaf in self._observed.leaves:
            flags = leaf.dtype.kind == "b"
            # cast, not viewed: a hostile byte of 2 would make a bool that is neither
            array = np.empty(leaf.shape, np.uint8 if flags else leaf.dtype)
            _copy(pieces, leaf.offset, array.reshape(-1).view(np.uint8).data)
            made.append(array.astype(np.bool_) if flags else array)
        return self._assemble(made)


def _copy(pieces: Sequence[Buffer], start: int, into: memoryview) -> None:
    """A range of what lies in several pieces."""
    at, stop = 0, start + len(into)
    for piece in pieces:
        begin, end = max(start, at), min(stop, at + len(piece))
        if begin < end:
            into[begin - start : end - start] = piece[begin - at : end - at]
        at += len(piece)

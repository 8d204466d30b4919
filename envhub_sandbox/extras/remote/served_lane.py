"""The lane of a client that cannot share memory: the server shares slabs with the runners.

The client is on another host, or the caller has chosen frames. A step is one message each way:
the client's half of each shard's request slab goes out, the contents of the reply and observation
slabs come back. All other requests go as over ``Lane``, and so do steps if several are in flight,
since a slab has room for one step.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import partial
from time import perf_counter_ns
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline, SpinChooser
from envhub_sandbox.transport.jail import Frames
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError, expect_reply, typed_reply
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.client_slabs import (
    NO_MORE,
    Outcome,
    ShardSlabs,
    action_layouts,
)
from envhub_sandbox.transport.shared_memory.slab_lane import STEP, ColumnSteps
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.shared_memory import slabs

_HEAD = struct.Struct("<QQ")
_HEAD_AT = slabs.OUTCOME * 8
_PLAIN = slabs.DONE, 0
_BYTE, _FLAG, _REWARD = map(np.dtype, (np.uint8, np.bool_, np.float64))


class ServedLane(ColumnSteps):
    """Steps in columns (``ColumnSteps``) through the server's slabs.
    ``relay``: the lane over the server, to the same runners.
    ``shards``: the slabs of each shard.
    """

    shards: list[ServedShard]

    def __init__(self, relay: Lane, shards: list[ServedShard]) -> None:
        self.shards = shards
        batch = ReceivedBatch(relay.declared.manifest.single_observation_space, shards)
        super().__init__(shards[0].layout, batch, relay)
        self._spin = SpinChooser(True, slabs.MAX_SPIN_NS)
        # Whether the present steps are messages; whether the next ones shall be, since a caller has
        # several in flight; whether the last step went through the slabs.
        self._by_message = self._more_wanted = self._by_slabs = False

    @classmethod
    def open(cls, relay: Lane, deadline: Deadline) -> ServedLane | None:
        """Make a lane; None if the spaces have no fixed layout, or the server or a runner refuses.
        Raises ``WorkerError``: A runner died, or took too long.
        """
        results = relay.declared
        space = results.manifest.single_observation_space
        shards = [
            ServedShard(layout, observed)
            for layout in action_layouts(results) or ()
            if (observed := slabs.observation_layout(space, layout.count, 1)) is not None
        ]
        if len(shards) < len(results.slices):
            return None
        lane = cls(relay, shards)
        return lane if lane._attach(range(len(shards)), deadline) else None

    def renew(self, dead: Sequence[int], fresh: Sequence[int], deadline: Deadline) -> None:
        """Implements ``Lane.renew``; new runners get new slabs, which the dead ones never saw."""
        super().renew(dead, fresh, deadline)
        for index in dead:
            self.shards[index] = ServedShard(self.shards[index].layout, self.shards[index].observed)
        if not self._attach(dead, deadline, again=True):
            raise RemoteProtocolError("a new runner refuses slabs, which the others use")

    def _attach(self, shards: Sequence[int], deadline: Deadline, *, again: bool = False) -> bool:
        """Have the server make slabs and the runners serve them; returns whether all do.
        ``again``: whether other shards have slabs already, so that a refusal is an error.
        """
        runners, wanted = self.runners, [(index, self.shards[index]) for index in shards]
        sizes = tuple((runners[index], *shard.sizes) for index, shard in wanted)
        if not all(slabs.served(*size[1:], self.jail.limits.message_bytes) for size in sizes):
            return False
        request = m.ShareSlabs(self.jail.number, sizes)
        reply, _ = self.jail.client.request(request, deadline=deadline)
        if isinstance(reply, m.Refusal) and not again:  # its limits or a quota may be lower
            return False
        expect_reply(reply, m.Done)
        parts = tuple((runner, 1) for runner in runners)
        self._step = m.Relay(self.jail.number, STEP, parts, False, True)
        messages: list[tuple[int, m.Message]] = [
            (runners[index], m.Attach(self.number, 0, shard.layout.count, 1))
            for index, shard in wanted
        ]
        replies = self.jail.exchange("attach", messages, deadline, deposited=True)
        return all(typed_reply(reply, m.Value).value is True for reply in replies)

    @property
    def takes_more(self) -> bool:
        """Implements ``Lane.takes_more``: only while steps are messages."""
        return self._by_message and super().takes_more

    def expect_more(self) -> None:
        """Implements ``Lane.expect_more``: the next step that is sent alone is a message."""
        self._more_wanted = True

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        """Implements ``Lane.send_step``."""
        if not ahead:
            self._by_message, self._more_wanted = self._more_wanted, False
        if self._by_message and super().takes_more:
            super().send_step(actions, ahead=ahead)
            return
        self._asked_ns = perf_counter_ns()
        spin_ns, shards = self._spin.budget_ns, zip(self.shards, self._rows(actions), strict=True)
        payload = [shard.ask(leaves, spin_ns) for shard, leaves in shards]
        self._send(partial(self.jail.send_relay, self._step, payload), self._read)

    def _read(self, index: int, frames: Frames) -> Outcome:
        return self.shards[index].read(frames)

    @property
    def _by_server(self) -> bool:
        return not self._owed or self._owed[0][2] is None

    def wait(self, deadline: Deadline) -> None:
        """Implements ``Lane.wait``."""
        self._by_slabs = not self._by_server
        if self._by_slabs:
            super().wait(deadline)
        else:
            Lane.wait(self, deadline)

    def result(self) -> StepResult:
        """Implements ``Lane.result``. Trust: input from the worker."""
        return super().result() if self._by_slabs else Lane.result(self)

    def _outcomes(self, deadline: Deadline) -> tuple[list[Outcome], dict[int, WorkerDiedError]]:
        deaths: dict[int, WorkerDiedError] = {}
        outcomes: list[Outcome | None]
        try:
            outcomes = [*self.replies(deadline)]
        except RunnersDiedError as error:
            outcomes, deaths = error.replies, error.deaths
        self.elapsed_ns = perf_counter_ns() - self._asked_ns
        if 0 < self._spin.budget_ns < self.elapsed_ns:
            self._spin.missed()  # the runner has gone to sleep: a missed spin
        self._spin.measured(self.elapsed_ns)
        said = [outcome or NO_MORE for outcome in outcomes]
        return said if deaths or said != [NO_MORE] * len(said) else [], deaths

    def _incomplete(self) -> list[int] | None:
        """Implements ``SlabLane._incomplete``. Trust: input from the worker."""
        if not self.jail.client.arrived(self._owed[0][0]):
            return None
        parts = self.jail.arrived(self._owed[0][0])
        heads = [bytes(part[0][: _HEAD.size]) for part in parts]
        if not all(len(head) == _HEAD.size for head in heads):
            return []
        return [i for i, head in enumerate(heads) if _HEAD.unpack(head)[0] == slabs.FETCH]


class ServedShard(ShardSlabs):
    """Our half of one shard's slabs, and the other half as the server sent it.

    Args:
        layout, observed: The layouts of actions and of results.

    Attributes:
        observed: As given; it covers the rows of this shard alone.
        sizes: The number of leaves of the actions, and the bytes of the request slab and of the
            observation slab.
    """

    def __init__(self, layout: slabs.Layout, observed: slabs.ObservationLayout) -> None:
        request, reply = bytearray(layout.request_bytes), bytearray(slabs.REPLY_BYTES)
        super().__init__(layout, request, memoryview(reply))
        self.observed = observed
        self._received: Sequence[Buffer] = ()  # the observation slab, as the server sent it
        leaves = len(layout.actions)
        self.sizes = leaves, layout.request_bytes, observed.total_bytes
        # The bytes of a step: the client's words of the header, then the actions.
        self._words = memoryview(request)[slabs.OWN_BYTES : (slabs.DTYPES + leaves) * 8]
        self._written = memoryview(request)[slabs.HEADER_BYTES : layout.message]

    def ask(self, leaves: Sequence[Any], spin_ns: int) -> bytes:
        """The bytes that the server writes into the request slab for a step."""
        self.write(leaves, (0, spin_ns, 0))
        return b"".join((self._words, self._written))

    def read(self, frames: Frames) -> Outcome:
        """Read the outcome of a step, and keep its results. Trust: input from the worker."""
        first = memoryview(frames[0])
        if len(first) < _HEAD.size:
            raise RemoteProtocolError("the worker sent less than the outcome of a step")
        kind, length = _HEAD.unpack_from(first)
        size = self.known if kind == slabs.COLUMNS else min(length, slabs.INFO_BYTES)
        infos, rest = first[_HEAD.size : _HEAD.size + size], first[_HEAD.size + size :]
        received: list[Buffer] = [rest, *frames[1:]]
        if len(infos) < size or sum(map(len, received)) != self.observed.total_bytes:
            raise RemoteProtocolError("the worker sent slabs of another size than was agreed on")
        self._received = received
        if (kind, length) == _PLAIN:
            return NO_MORE
        self._reply[_HEAD_AT : _HEAD_AT + _HEAD.size] = first[: _HEAD.size]
        self._reply[slabs.INFOS : slabs.INFOS + size] = infos
        return self.outcome()

    def leaves(self) -> list[Any]:
        """The observations of this shard, by leaves."""
        return [self._array(leaf.dtype, leaf.shape, leaf.offset) for leaf in self.observed.leaves]

    def results(self) -> tuple[Any, Any, Any]:
        """The rewards, terminations and truncations of this shard; drops the received frames."""
        start, count = self.observed.results, self.layout.count
        rewards = self._array(_REWARD, (count,), start)
        flags = self._array(_FLAG, (2 * count,), start + rewards.nbytes)
        self._received = ()  # so that the next large batch can use the memory
        return rewards, flags[:count], flags[count:]

    def _array(self, dtype: np.dtype[Any], shape: tuple[int, ...], start: int) -> Any:
        # cast, not viewed as bool: a hostile byte of 2 would be neither True nor False
        raw = _BYTE if dtype == _FLAG else dtype
        if len(self._received) == 1:
            return np.ndarray(shape, raw, self._received[0], start).astype(dtype)
        array = np.empty(shape, raw)
        _copy(self._received, start, array.reshape(-1).view(_BYTE).data)
        return array.astype(dtype, copy=False)


class ReceivedBatch:
    """Joins the results of all shards from frames into arrays that the caller owns.
    ``space``: the single observation space; ``shards``: the slabs of each shard.
    """

    def __init__(self, space: gym.Space[Any], shards: Sequence[ServedShard]) -> None:
        self._assemble = slabs.assembler(space)
        self._shards = shards

    def take(self) -> Any:
        """The observations, in the structure of the space."""
        if len(self._shards) == 1:  # as below, in less time
            return self._assemble(self._shards[0].leaves())
        leaves = zip(*(shard.leaves() for shard in self._shards), strict=True)
        return self._assemble(list(map(np.concatenate, leaves)))

    def results(self) -> tuple[Any, Any, Any]:
        """Rewards (float64), terminations, truncations (bool), ``(num_envs,)``. Once a step."""
        if len(self._shards) == 1:
            return self._shards[0].results()
        columns = zip(*(shard.results() for shard in self._shards), strict=True)
        rewards, over, cut = map(np.concatenate, columns)
        return rewards, over, cut


def _copy(pieces: Sequence[Buffer], start: int, into: memoryview) -> None:
    """Copy a range of bytes that may span several pieces."""
    at, stop = 0, start + len(into)
    for piece in pieces:
        begin, end = max(start, at), min(stop, at + len(piece))
        if begin < end:
            into[begin - start : end - start] = piece[begin - at : end - at]
        at += len(piece)

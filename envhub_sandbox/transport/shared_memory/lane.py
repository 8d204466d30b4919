"""The client's end of the fast lane: steps over shared memory, straight to the jail's runners.

Each shard has two sealed memfds and a doorbell each way (``doorbell``). A step costs one wake-up
per shard and one copy out. Trust: the jail writes the reply slab whenever it likes, so every word
is read once and bounded, and bytes are copied before they are looked at. ``F_SEAL_SHRINK`` keeps
it from cutting the memory away under us (which would be a SIGBUS).
"""

from __future__ import annotations

import os
import platform
import socket
from collections import deque
from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import RemoteProtocolError, WorkerTimeoutError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.shared_memory.affinity import CPUS, Cores
from envhub_sandbox.transport.shared_memory.doorbell import OwnBell, RunnerBell, Watch
from envhub_sandbox.transport.shared_memory.memfd import SEAL_FUTURE_WRITE, slab
from envhub_sandbox.transport.shared_memory.observations import RING, ObservationSlab
from envhub_sandbox.transport.shared_memory.sharding import (
    ASK_NS,
    Cost,
    Pace,
    Sample,
    awake_shards,
    pace_of,
)
from envhub_sandbox.transport.shared_memory.spin import SpinChooser
from envhub_sandbox.transport.tensors import to_tensor
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest import EnvManifest
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import Column, columns_of
from envhub_worker.protocol.stream import read_packet
from envhub_worker.protocol.untrusted import UNTRUSTED

_RECHECK_MS = 2
_CONNECT_S = 5.0
_PACE_STEPS = 256
"""Steps after which what they took is worth remembering."""
_SAMPLE_EVERY = 64
"""Steps between two samples; the runners measure every 32nd."""
_SAMPLES = 64
# elsewhere a core may see the sequence word before the data it announces: sleep, do not poll
_ORDERED_STORES = platform.machine() in ("x86_64", "AMD64")


Outcome = tuple[int, m.Message | None]
"""``slabs.DONE``, ``RAISED``, ``FETCH`` or ``COLUMNS``, and what came encoded."""
_OUTCOMES = frozenset({slabs.DONE, slabs.RAISED, slabs.FETCH, slabs.COLUMNS})


_NOTHING: list[Outcome] = []


class JailGoneError(Exception):
    """The jail has ended; the server knows why."""


class LaneShard:
    """The slabs and doorbells of one shard.

    Args:
        layout: Where everything lies.
        observations: The descriptor of the slab that all shards share.

    Attributes:
        fds: What the runner gets: three slabs, its doorbell, ours.
        bell: Our doorbell, to be watched.
    """

    def __init__(self, layout: slabs.Layout, observations: int) -> None:
        self.layout = layout
        self._request, request_fd = slab("request", layout.request_bytes, SEAL_FUTURE_WRITE)
        self._reply, reply_fd = slab("reply", layout.reply_bytes)
        self._runner_bell, self.bell = RunnerBell(), OwnBell()
        self._ring = self._runner_bell.ring
        self._slab_fds = [request_fd, reply_fd]
        bells = [self._runner_bell.theirs, self.bell.fileno()]
        self.fds = [request_fd, reply_fd, observations, *bells]
        self._asks = slabs.words(self._request)
        self._tells = slabs.words(self._reply)
        self._columns: list[tuple[Column, Any]] = []
        self._views: dict[tuple[int, Any], Any] = {}
        self._codes = [-1] * len(layout.actions)
        self._wishes = (0, 0, 0)
        self._told = False
        self.sequence = 0

    def handed_over(self) -> None:
        """The runner has its copies of the descriptors; the maps keep ours alive."""
        while self._slab_fds:
            os.close(self._slab_fds.pop())
        self._runner_bell.handed_over()

    def ask(self, leaves: Sequence[Any], slot: int, spin_ns: int, cpu: int = 0) -> None:
        """Write a shard's actions and announce them; its observations are to go to ``slot``."""
        asks = self._asks
        if self._told:
            asks[slabs.MESSAGE] = 0
            self._told = False
        for index, leaf in enumerate(leaves):
            found = self._views.get((index, leaf.dtype))
            if found is None:
                found = self._view(index, leaf.dtype)
            if self._codes[index] != found[0]:
                asks[slabs.DTYPES + index] = self._codes[index] = found[0]
                asks[slabs.CHANGES] += 1
            found[1][...] = leaf
        wishes = (spin_ns, slot, cpu)
        if wishes != self._wishes:
            self._wish(*wishes)
        self._announce()

    def tell(self, packet: bytes, slot: int, spin_ns: int = 0, cpu: int = 0) -> None:
        """Write a message and announce it."""
        start = self.layout.message
        self._request[start : start + len(packet)] = packet
        self._asks[slabs.MESSAGE] = len(packet)
        self._told = True
        wishes = (spin_ns, slot, cpu)
        if wishes != self._wishes:
            self._wish(*wishes)
        self._announce()

    def _announce(self) -> None:
        self.sequence += 1
        self._asks[slabs.SEQUENCE] = self.sequence
        if self._tells[slabs.PARKED]:
            self._ring()

    def _wish(self, spin_ns: int, slot: int, cpu: int) -> None:
        asks = self._asks
        self._wishes = (spin_ns, slot, cpu)
        asks[slabs.SPIN] = spin_ns
        asks[slabs.SLOT] = slot
        asks[slabs.CPU] = cpu
        asks[slabs.CHANGES] += 1

    def _view(self, index: int, dtype: Any) -> tuple[int, Any]:
        code = slabs.DTYPE_CODES[dtype]
        leaf = self.layout.actions[index]
        made = self._views[index, dtype] = (code, slabs.view(self._request, leaf, dtype))
        return made

    def answered(self) -> bool:
        """Whether the reply to the last request is there."""
        return self._tells[slabs.SEQUENCE] == self.sequence

    def answered_until(self, until_ns: int) -> bool:
        """Whether it comes before that time; waits awake."""
        tells, sequence = self._tells, self.sequence
        while tells[slabs.SEQUENCE] != sequence:
            if perf_counter_ns() > until_ns:
                return False
        return True

    def has_nothing_to_say(self) -> bool:
        """Whether the reply is results and nothing else."""
        tells = self._tells
        return tells[slabs.OUTCOME] == slabs.DONE and not tells[slabs.LENGTH]

    @property
    def busy_ns(self) -> int:
        """What the last measured step took the runner. Trust: it says so itself."""
        return self._tells[slabs.BUSY]

    def park(self, parked: int) -> None:
        """Say whether we sleep and want our doorbell rung."""
        self._asks[slabs.PARKED] = parked

    def outcome(self) -> Outcome:
        """How the request went. Trust: input from the worker; the length is bounded here.

        What came encoded is decoded at once, wanted or not: the columns that follow are its.
        """
        kind, length = self._tells[slabs.OUTCOME], self._tells[slabs.LENGTH]
        if kind not in _OUTCOMES or length > slabs.INFO_BYTES:
            raise RemoteProtocolError("the worker wrote an impossible reply into its slab")
        if not length:
            return kind, None
        start = self.layout.infos
        message = m.unpack([self._reply[start : start + length]], tensors=to_tensor)[1]
        if isinstance(message, m.Value) and type(message.value) is dict:
            with UNTRUSTED:
                self._learn(message.value)
        return kind, message

    def answer(self) -> m.Message | None:
        """The answer to a message; None if it did not fit. Trust: as ``outcome``."""
        kind, length = self._tells[slabs.OUTCOME], self._tells[slabs.LENGTH]
        if kind == slabs.FETCH:
            return None
        if kind not in (slabs.DONE, slabs.RAISED) or length > slabs.INFO_BYTES:
            raise RemoteProtocolError("the worker wrote an impossible answer into its slab")
        if kind == slabs.RAISED:
            return self.outcome()[1]
        start = self.layout.answer
        with UNTRUSTED:
            packet = read_packet(self._reply[start : start + length])
        return m.unpack(packet.frames, tensors=to_tensor)[1]

    def _learn(self, infos: dict[Any, Any]) -> None:
        start = self.layout.infos
        columns = columns_of(infos) or ()
        self._columns = [(column, column.view(self._reply, start)) for column in columns]

    def columns(self) -> dict[Any, Any]:
        """Infos that came as columns: fresh arrays."""
        if not self._columns:
            raise RemoteProtocolError("the worker sent columns before their schema")
        return {column.key: view.astype(column.dtype) for column, view in self._columns}

    def close(self) -> None:
        """Give everything back."""
        self.handed_over()
        self._runner_bell.close()
        self.bell.close()
        self._asks.release()
        self._tells.release()
        # the maps go with the last array over them


class FastLane:
    """Steps of one environment, over all its shards.

    Args:
        manifest: Its spaces.
        bounds: The slices of the sub-environments, one for each shard.
        observed: Where the observations lie.
        layouts: Where each shard's actions and infos lie.
        process_fd: Readable once the worker server has ended.
    """

    def __init__(
        self,
        manifest: EnvManifest,
        bounds: Sequence[tuple[int, int]],
        observed: slabs.ObservationLayout,
        layouts: Sequence[slabs.Layout],
        process_fd: int,
    ) -> None:
        self.observations = ObservationSlab(manifest.single_observation_space, observed)
        self.shards = [LaneShard(layout, self.observations.fd) for layout in layouts]
        self._bounds = list(bounds)
        self._action_space = manifest.single_action_space
        leaves = layouts[0].actions
        self._flat_actions = len(leaves) == 1 and not leaves[0].path
        self._pidfds: dict[int, int] = {}
        self._watch = Watch()
        self._watch.death(process_fd)
        for shard in self.shards:
            self._watch.bell(shard.bell)
        may_spin = _ORDERED_STORES and len(CPUS) > 1
        self._spin = self._step_spin = SpinChooser(may_spin)
        self._talk_spin = SpinChooser(may_spin)  # messages take another time than steps
        self._asked_ns = 0
        self.elapsed_ns = 0
        self._slept_ns = 0
        self._samples: deque[Sample] = deque(maxlen=_SAMPLES)
        # One core is the client's. Shards that find no other sleep until they are asked, then run
        # on the client's while it sleeps: so it waits for those first, and for the others awake.
        self._awake = awake_shards(len(self.shards))
        self._cores = Cores(len(self.shards), self._awake)
        self._sleepers = self.shards[self._awake :]
        self._wakers = self.shards[: self._awake]

    @classmethod
    def for_spaces(
        cls,
        manifest: EnvManifest,
        bounds: Sequence[tuple[int, int]],
        process_fd: int,
        *,
        copy: bool,
    ) -> FastLane | None:
        """A lane with fresh slabs, or None where the spaces have no fixed layout."""
        slots = 1 if copy else 1 + RING
        space, count = manifest.single_observation_space, manifest.num_envs
        observed = slabs.observation_layout(space, count, slots)
        sizes = [stop - start for start, stop in bounds]
        layouts = [slabs.layout_of(manifest.single_action_space, size) for size in sizes]
        known = [layout for layout in layouts if layout is not None]
        if observed is None or len(known) < len(layouts):
            return None
        return cls(manifest, bounds, observed, known, process_fd)

    def attach_message(self, env: int, shard: int) -> m.Attach:
        """What tells a shard's runner which rows of the batch are its own."""
        layout = self.observations.layout
        return m.Attach(env, self._bounds[shard][0], layout.count, layout.slots)

    def watch_runner(self, index: int, pidfd: int) -> None:
        """End waits when a shard's runner ends, or all of its jail. Takes the descriptor over."""
        self._pidfds[index] = pidfd
        self._watch.death(pidfd)

    def renew(self, index: int) -> None:
        """Give a shard whose runner has died slabs that the dead one never saw."""
        old, pidfd = self.shards[index], self._pidfds.pop(index)
        self._watch.forget(pidfd)
        os.close(pidfd)
        self._watch.forget(old.bell)
        fresh = self.shards[index] = LaneShard(old.layout, self.observations.fd)
        self._watch.bell(fresh.bell)
        self._sleepers = self.shards[self._awake :]
        self._wakers = self.shards[: self._awake]
        old.close()

    def survivors(self, deadline: Deadline) -> list[int]:
        """After ``JailGoneError``: the shards that have answered, once no other will any more.

        Raises:
            WorkerTimeoutError: The deadline came first.
        """
        pairs = [(shard, self._pidfds[index]) for index, shard in enumerate(self.shards)]
        return [i for i, (shard, pidfd) in enumerate(pairs) if _answers(shard, pidfd, deadline)]

    def ask(self, actions: Any) -> None:
        """Send a validated batch of actions to every shard."""
        leaves = [actions] if self._flat_actions else slabs.flatten(self._action_space, actions)
        self._asked_ns = perf_counter_ns()
        self._spin = self._step_spin
        spin_ns = self._spin.budget_ns
        slot = self.observations.choose()
        if len(self.shards) == 1:
            self.shards[0].ask(leaves, slot, spin_ns)
            return
        if not self.shards[0].sequence % _SAMPLE_EVERY:
            self._sample()
        cpus = self._cores.of_shards()
        for index, (shard, (start, stop)) in enumerate(zip(self.shards, self._bounds, strict=True)):
            rows = [leaf[start:stop] for leaf in leaves]
            shard.ask(rows, slot, spin_ns if index < self._awake else 0, cpus[index])

    def tell(self, packets: Sequence[bytes], *, moves: bool) -> None:
        """Send each shard a message; if it ``moves``, what it writes must not be held by anyone."""
        self._asked_ns = perf_counter_ns()
        self._spin = self._talk_spin
        slot = self.observations.choose() if moves else self.observations.chosen
        spin_ns, cpus = self._spin.budget_ns, self._cpus()
        for index, (shard, packet) in enumerate(zip(self.shards, packets, strict=True)):
            shard.tell(packet, slot, spin_ns if index < self._awake else 0, cpus[index])

    def _cpus(self) -> list[int]:
        # one shard alone is left to the kernel
        return self._cores.of_shards() if len(self.shards) > 1 else [0]

    def answers(self) -> list[m.Message | None]:
        """What the shards said to a message; None where it did not fit."""
        return [shard.answer() for shard in self.shards]

    def wait(self, deadline: Deadline) -> list[Outcome]:
        """Every shard's outcome; nothing at all if none says more than its results.

        Raises:
            WorkerTimeoutError: The deadline came first.
            JailGoneError: The jail has ended.
            RemoteProtocolError: A shard wrote what the rules forbid.
        """
        self.wait_for_all(deadline)
        for shard in self.shards:
            if not shard.has_nothing_to_say():
                return [shard.outcome() for shard in self.shards]
        return _NOTHING

    def wait_for_all(self, deadline: Deadline) -> None:
        """Until every shard has answered; raises as ``wait`` does."""
        for shard in self._sleepers:
            self._sleep_for(shard, deadline)
        budget_ns = self._spin.budget_ns
        now_ns = perf_counter_ns()
        self._slept_ns = now_ns - self._asked_ns
        until_ns = now_ns + budget_ns
        for shard in self._wakers:
            if not budget_ns or not shard.answered_until(until_ns):
                if budget_ns:
                    self._spin.missed()
                self._sleep_for(shard, deadline)
        self.elapsed_ns = perf_counter_ns() - self._asked_ns
        self._spin.measured(self.elapsed_ns)

    def _sleep_for(self, shard: LaneShard, deadline: Deadline) -> None:
        shard.park(1)
        try:
            # a ring may cross with our going to sleep: look again soon, once
            timeout: int | None = _RECHECK_MS
            while not shard.answered():
                if self._watch.wait(timeout) and not shard.answered():
                    raise JailGoneError
                if deadline.passed and not shard.answered():
                    raise WorkerTimeoutError("the worker did not answer in time")
                timeout = deadline.left_ms()
        finally:
            shard.park(0)

    def _sample(self) -> None:
        """Take note of the last step, which every shard has measured."""
        busy = [shard.busy_ns for shard in self.shards]
        asleep, awake = busy[self._awake :], busy[: self._awake]
        if asleep and awake and all(busy):
            sample = Sample(self._slept_ns, self.elapsed_ns, max(asleep), max(awake))
            self._samples.append(sample)

    def pace(self) -> Pace | None:
        """What the steps took; None after too few of them."""
        if self.shards[0].sequence < _PACE_STEPS:
            return None
        sizes = [stop - start for start, stop in self._bounds]
        if self._samples:
            return pace_of(self._samples, max(sizes[self._awake :]), max(sizes[: self._awake]))
        busy = sum(shard.busy_ns for shard in self.shards)
        return Pace(Cost(ASK_NS, busy / sum(sizes)), None) if busy else None

    def observation(self) -> Any:
        """The batched observation: arrays that no later step changes."""
        return self.observations.take()

    def flags(self) -> tuple[Any, Any, Any]:
        """Rewards float64, terminations and truncations bool: fresh arrays ``(num_envs,)``."""
        return self.observations.results()

    def close(self) -> None:
        """Give everything back."""
        for shard in self.shards:
            shard.close()
        self._watch.close()
        self.observations.close()
        while self._pidfds:
            os.close(self._pidfds.popitem()[1])


def _answers(shard: LaneShard, pidfd: int, deadline: Deadline) -> bool:
    """Whether a shard's answer comes before its runner's death."""
    watch = Watch()
    watch.bell(shard.bell)
    watch.death(pidfd)
    shard.park(1)
    try:
        timeout: int | None = _RECHECK_MS
        while not shard.answered():
            if watch.wait(timeout):
                return shard.answered()
            if deadline.passed and not shard.answered():
                raise WorkerTimeoutError("the worker did not answer in time")
            timeout = deadline.left_ms()
        return True
    finally:
        shard.park(0)
        watch.close()


def deposit(path: str, session: bytes, jail: int, runner: int, fds: Sequence[int]) -> int:
    """Hand descriptors to the server for a runner; returns a pidfd of the jail, or of the runner.

    Raises:
        OSError: The server did not take them.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(_CONNECT_S)
        connection.connect(path)
        [frame] = m.pack(m.Deposit(session, jail, runner), 0)
        socket.send_fds(connection, [frame], list(fds))
        data, received, _, _ = socket.recv_fds(connection, 16, 1)
    if data != b"k" or len(received) != 1:
        raise ConnectionError("the worker server did not take the descriptors")
    return received[0]

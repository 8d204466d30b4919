"""One shard's end of the fast lane: its slabs, its doorbells, and what its runner wrote.

Each shard has two sealed memfds and a doorbell each way (``doorbell``). Trust: as in
``shard_slabs``. ``F_SEAL_SHRINK`` keeps the jail from cutting the memory away under us (which would
be a SIGBUS).
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import RECHECK_MS
from envhub_sandbox.transport.shared_memory.shard_slabs import ShardSlabs
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.doorbell import OwnBell, RunnerBell, Watch
from envhub_worker.protocol.shared_memory.memfd import SEAL_FUTURE_WRITE, sealed_memfd


class LaneShard(ShardSlabs):
    """The slabs and doorbells of one shard.

    Args:
        layout: Where everything lies.
        observations: The descriptor of the slab that all shards share.

    Attributes:
        fds: What the runner gets: three slabs, its doorbell, ours.
        bell: Our doorbell, to be watched.
    """

    def __init__(self, layout: slabs.Layout, observations: int) -> None:
        asks, request = sealed_memfd("request", layout.request_bytes, SEAL_FUTURE_WRITE)
        tells, reply = sealed_memfd("reply", layout.reply_bytes)
        super().__init__(layout, asks, tells)
        self._runner_bell, self.bell = RunnerBell(), OwnBell()
        self._ring = self._runner_bell.ring
        self._slab_files = [request, reply]
        bells = [self._runner_bell.theirs, self.bell.fileno()]
        self.fds = [request.fileno(), reply.fileno(), observations, *bells]
        self.sequence = 0

    def handed_over(self) -> None:
        """The runner has its copies of the descriptors; the maps keep ours alive."""
        while self._slab_files:
            self._slab_files.pop().close()
        self._runner_bell.handed_over()

    def ask(self, leaves: Sequence[Any], slot: int, spin_ns: int, cpu: int = 0) -> None:
        """Write a shard's actions and announce them."""
        self.write(leaves, slot, spin_ns, cpu)
        self._announce()

    def tell(self, packet: bytes, slot: int, spin_ns: int = 0, cpu: int = 0) -> None:
        """Write a message and announce it."""
        self.write_message(packet, slot, spin_ns, cpu)
        self._announce()

    def _announce(self) -> None:
        self.sequence += 1
        self._asks[slabs.SEQUENCE] = self.sequence
        if self._tells[slabs.PARKED]:
            self._ring()

    def answered(self) -> bool:
        """Whether the reply to the last request is there."""
        return self._tells[slabs.SEQUENCE] == self.sequence

    def listen(self, wanted: bool) -> None:
        """Whether we want our doorbell rung. A ring may cross with this: look again soon, once."""
        self._asks[slabs.PARKED] = wanted

    def answered_until(self, until_ns: int) -> bool:
        """Whether it comes before that time; waits awake."""
        tells, sequence = self._tells, self.sequence
        while tells[slabs.SEQUENCE] != sequence:
            if perf_counter_ns() > until_ns:
                return False
        return True

    def has_more_elsewhere(self) -> bool:
        """Whether a part of the reply did not fit, and has to be fetched."""
        return self._tells[slabs.OUTCOME] == slabs.FETCH

    def answered_before_death(self, watch: Watch, deadline: Deadline) -> bool:
        """Sleep until the reply is there, or a process dies; whether it is there.

        Raises:
            WorkerTimeoutError: The deadline came first.
        """
        self._asks[slabs.PARKED] = 1  # we want our doorbell rung
        try:
            # a ring may cross with our going to sleep: look again soon, once
            timeout: int | None = RECHECK_MS
            while not self.answered():
                died = watch.wait(timeout)
                if self.answered():
                    return True
                if died:
                    return False
                if deadline.passed:
                    raise WorkerTimeoutError("the worker did not answer in time")
                timeout = deadline.left_ms()
            return True
        finally:
            self._asks[slabs.PARKED] = 0

    def close(self) -> None:
        """Give everything back."""
        self.handed_over()
        self._runner_bell.close()
        self.bell.close()
        super().close()

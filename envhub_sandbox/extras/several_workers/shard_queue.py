"""``send`` and ``recv`` to several workers in one jail: a queue for each worker.

Each worker gets messages of its own, whatever lane the steps of all workers use; the request's
number identifies its answer. The session has one state for all workers: it is ``PENDING`` while any
worker owes an answer, and if the session ends, it ends for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.extras.several_workers.worker_queue import WorkerQueue
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.requests import MessageFor
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State


class ShardQueue(WorkerQueue):
    """The queue of one worker of a jail: see ``WorkerQueue``.

    Args:
        part: The session of all workers in the jail.
        shard: The index of this worker.
        others: The queues of all workers; this queue is appended to it.
    """

    def __init__(self, part: EnvSession, shard: int, others: list[ShardQueue]) -> None:
        super().__init__(part, part.bounds[shard], sliced=True)
        self._shard, self._others = shard, others
        self._whole: Lane | None = None  # the environment's lane, of which ``_way`` is a part
        self._way: Lane | None = None  # to this worker alone
        others.append(self)

    @property
    def lane(self) -> Lane | None:
        """The lane to wait on; None if nothing is owed."""
        return self._way if self._owed else None

    def _results(self) -> Results:
        return self._shard_lane().declared

    def _shard_lane(self) -> Lane:
        """The lane to this worker alone, in the present jail."""
        whole = self.part.lease.lane
        assert whole is not None
        if self._way is None or self._whole is not whole:
            self._whole, self._way = whole, whole.of_shard(self._shard)
        return self._way

    # --- sending ---------------------------------------------------------------------------------

    def _is_ready(self, operation: str) -> bool:
        """Whether a request can be sent at once; other shards may still owe answers."""
        state = self.part.lifecycle.state
        return state is State.READY or (state is State.PENDING and bool(_owing(self._others)))

    def step(self, actions: Any) -> None:
        """Implements ``WorkerQueue.step``."""
        self._submit("step", m.Step(self._shard_lane().number, actions))

    def reset(self, message_for: MessageFor) -> None:
        """Implements ``WorkerQueue.reset``."""
        self._submit("reset", message_for(self._shard_lane().number, self.rows))

    def _submit(self, operation: str, message: m.Message) -> None:
        lane, whole = self._shard_lane(), self._whole
        assert whole is not None
        whole.leave_slots()
        self._try(operation, partial(self._requests.submit_alone, lane, operation, message))

    # --- receiving -------------------------------------------------------------------------------

    def _collect(self) -> tuple[Any, ...]:
        self.part.lifecycle.request = operation = self._owed[0]
        lane, is_step = self._shard_lane(), operation == "step"
        kind: Any = m.StepDone if is_step else m.ResetDone
        replies = self._requests.collect(self._deadline, kind, lane)
        try:
            return lane.declared.step(replies) if is_step else lane.declared.reset(replies)
        except EnvHubError:
            with self._requests.use.judging("recv"):  # only on failure, as it costs microseconds
                raise

    def _go_on(self) -> None:
        self._owed.popleft()
        if self.part.lifecycle.state is not State.READY:
            lost = {row for queue in (self, *_owing(self._others)) for row in range(*queue.rows)}
            self._lost = tuple(sorted(lost))
            for queue in self._others:
                queue.forget()
            return
        owing = _owing(self._others)
        if owing:
            self._requests.owe(owing[0]._owed[0])
        if self._owed:
            self._begin()
        self.taking = False

    def forget(self) -> None:
        """Expect nothing more; a later reset waits for the answers that this worker still owes."""
        if self._owed and self._way is not None and self._whole is not None:
            self._whole.owe_for(self._way)
        self._way = None
        super().forget()


def _owing(queues: Sequence[ShardQueue]) -> list[ShardQueue]:
    return [queue for queue in queues if queue._owed]

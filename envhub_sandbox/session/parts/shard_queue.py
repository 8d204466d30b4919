"""``send`` and ``recv`` where several workers live in one jail: the queue of each of them.

Each worker gets messages of its own, whatever lane steps of all workers take; a request's number
tells its answer from others. The session has one state for all workers, ``PENDING`` as long as any
owes an answer; if it ends, it ends for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.parts.worker_queue import WorkerQueue
from envhub_sandbox.session.requests import MessageFor
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State


class ShardQueue(WorkerQueue):
    """What one worker of a jail owes: see ``WorkerQueue``.

    Args:
        part: The session of all of them.
        shard: Which worker it is.
        others: The queues of all, which this one is appended to.
    """

    def __init__(self, part: EnvSession, shard: int, others: list[ShardQueue]) -> None:
        super().__init__(part, part.bounds[shard], sliced=True)
        self._shard, self._others = shard, others
        self._whole: Lane | None = None
        self._way: Lane | None = None
        others.append(self)

    @property
    def lane(self) -> Lane | None:
        """See ``WorkerQueue``."""
        return self._way if self._owed else None

    def _results(self) -> Results:
        return self._shard_lane().declared

    def _shard_lane(self) -> Lane:
        """The way to this worker alone, in the jail that there is."""
        whole = self.part.lease.lane
        assert whole is not None
        if self._way is None or self._whole is not whole:
            self._whole, self._way = whole, whole.of_shard(self._shard)
        return self._way

    # --- sending ---------------------------------------------------------------------------------

    def _is_ready(self, operation: str) -> bool:
        """Also while other shards of the jail have not answered."""
        state = self.part.lifecycle.state
        return state is State.READY or (state is State.PENDING and bool(_owing(self._others)))

    def step(self, actions: Any) -> None:
        """See ``WorkerQueue``."""
        self._submit("step", m.Step(self._shard_lane().number, actions))

    def reset(self, message_for: MessageFor) -> None:
        """See ``WorkerQueue``."""
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
            with self._requests.use.judging("recv"):  # on failure only: it costs some us
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
        """See ``WorkerQueue``. A reset waits for what the worker owes still."""
        if self._owed and self._way is not None and self._whole is not None:
            self._whole.owe_for(self._way)
        self._way = None
        super().forget()


def _owing(queues: Sequence[ShardQueue]) -> list[ShardQueue]:
    return [queue for queue in queues if queue._owed]

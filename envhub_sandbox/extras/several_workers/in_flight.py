"""``send`` and ``recv``: requests in flight, which were sent to workers and not received yet.

A worker steps its sub-environments together, so they are ready together. Its answers are taken in
the order of its requests, so results depend only on actions and seeds. Speed determines only which
batch they are in.

Followed: EnvPool's ``send`` and ``recv``, and PufferLib's, for the ids beside the results.
"""

from __future__ import annotations

import copy
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import NoAsyncCallError

from envhub_sandbox.errors import ActionError, EnvHubError, RemoteEnvWarning, WorkerTimeoutError
from envhub_sandbox.extras.several_workers.part_locks import FleetUse, all_held
from envhub_sandbox.extras.several_workers.received_infos import gather_infos
from envhub_sandbox.extras.several_workers.shard_queue import ShardQueue
from envhub_sandbox.extras.several_workers.worker_queue import WorkerQueue
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.failures import refusal
from envhub_sandbox.session.requests import SENT, MessageFor, RequestOrder
from envhub_sandbox.transport.deadline import Deadline, deadline_of
from envhub_sandbox.transport.lane import answered_first
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.vector.send_recv import Received
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.limits import DEFAULT_LIMITS, LARGE_BYTES
from envhub_worker.protocol.spaces import batches


class Rows(NamedTuple):
    """A choice of sub-environments.

    Attributes:
        named: The ids, in the caller's order.
        workers: The indices of the workers that have exactly these sub-environments.
        order: The positions in ``named``, by ascending id; None if ``named`` is ascending.
    """

    named: list[int]
    workers: list[int]
    order: list[int] | None


class InFlight:
    """The requests in flight to all workers of an environment.

    One thread at a time uses it. Another thread may call ``close``: a wait holds the locks of the
    workers that it waits for, so ``close`` ends it like any request (interruption.md, rule 11).
    ``order``: the requests of the environment.
    ``parts``: the session of each worker, in the order of their sub-environments.
    """

    def __init__(self, order: RequestOrder, parts: Sequence[EnvSession]) -> None:
        self._order = order
        self._queues = _queues_of(parts)
        self._shared = any(isinstance(queue, ShardQueue) for queue in self._queues)
        self._space = order.results.manifest.single_observation_space
        self._actions = order.results.manifest.single_action_space
        self._worker_of = [at for at, queue in enumerate(self._queues) for _ in range(queue.count)]
        # Taken, not received; by worker.
        self._ready: deque[tuple[int, StepResult | Exception]] = deque()
        self._sends = False  # True from the first message of a ``send`` to its last

    # --- sending ---------------------------------------------------------------------------------

    def rows(self, env_ids: Any) -> Rows:
        """The rows with these ids; all rows for None.
        Raises ``ActionError``: an id does not exist or occurs twice, or the ids lack a
        sub-environment that shares a worker with them.
        """
        count = len(self._worker_of)
        if env_ids is None:
            return Rows(list(range(count)), list(range(len(self._queues))), None)
        try:
            ids = np.asarray(env_ids)
        except ValueError:  # rows of several lengths
            ids = np.empty(0)
        if ids.ndim != 1 or not ids.size or ids.dtype.kind not in "iu":
            raise ActionError(f"env_ids is {env_ids!r}; it takes a list such as [0, 3]")
        named: list[int] = ids.tolist()
        ordered = sorted(named)
        if ordered[0] < 0 or ordered[-1] >= count:
            raise ActionError(f"env_ids is {named}; the sub-environments are 0 to {count - 1}")
        if len(set(named)) < len(named):
            raise ActionError(f"env_ids names a sub-environment twice: {named}")
        order = None if named == ordered else sorted(range(len(named)), key=named.__getitem__)
        return Rows(named, self._workers_of(ordered), order)

    def _workers_of(self, ordered: list[int]) -> list[int]:
        workers = [*dict.fromkeys(self._worker_of[index] for index in ordered)]
        if sum(self._queues[worker].count for worker in workers) == len(ordered):
            return workers
        for worker in workers:
            start, stop = self._queues[worker].rows
            for missing in sorted({*range(start, stop)} - {*ordered}):
                raise ActionError(
                    f"sub-environments {start} to {stop - 1} are stepped together, by one worker, "
                    f"and env_ids lacks {missing}: name all of them, or give each a worker of its "
                    "own, with num_workers"
                )
        return workers

    def send(self, rows: Rows, actions: Any) -> None:
        """Send each worker its slice of a validated batch, which is in the order of the ids.

        Raises as ``Requests.submit_step`` does, if nothing was sent; ``recv`` raises later
        failures.
        """
        if rows.order is not None:
            actions = batches.reordered(self._actions, actions, rows.order)
        if not isinstance(actions, np.ndarray) or actions.nbytes >= LARGE_BYTES:
            actions = copy.deepcopy(actions)  # large arrays are sent later and may change
        queues = self._of(rows)
        slices = list(pairwise(accumulate((queue.count for queue in queues), initial=0)))
        parts = [actions] if len(slices) == 1 else batches.split(self._actions, actions, slices)
        with self._sending("send", queues, WorkerQueue.prepare):
            for queue, part in zip(queues, parts, strict=True):
                queue.step(part)
            of_all = len(queues) == len(self._queues)
            self._order.note_sent(actions if of_all else None)
            if of_all and self._shared:
                queues[0].part.recorder.step(actions)

    def send_reset(self, rows: Rows, message_for: MessageFor) -> None:
        """Send each worker a reset of all of its sub-environments; raises as ``send``."""
        queues = self._of(rows)
        with self._sending("send_reset", queues, WorkerQueue.prepare_reset):
            for queue in queues:
                queue.reset(message_for)
            self._order.note_sent(None)

    def _of(self, rows: Rows) -> list[WorkerQueue]:
        return [self._queues[worker] for worker in rows.workers]

    @contextmanager
    def _sending(
        self, name: str, queues: Sequence[WorkerQueue], prepare: Callable[[WorkerQueue], None]
    ) -> Iterator[None]:
        """Prepare all workers before anything is sent; note what is in flight around the send."""
        # Every check and every ``prepare`` comes before the first message, so that a refusal has
        # sent nothing. ``waiting`` and ``_sends`` are set before the first message and cleared
        # after the last (interruption.md, rule 1): after an interrupt in between they are still
        # set, and all requests but ``reset`` are refused.
        with self._held(queues):
            if self._order.waiting != SENT:
                self._order.refuse_if_busy(name)
            self._order.refuse_if_closed()
            self._refuse_if_interrupted(name)
            for queue in queues:
                prepare(queue)
            self._order.waiting, self._sends = SENT, True
            yield
            self._sends = False
            self._note()

    def _held(self, queues: Sequence[WorkerQueue]) -> AbstractContextManager[None]:
        """Hold the locks of these workers: interruption.md, rule 10."""
        locks, use = [queue.part.use.lock for queue in queues], self._order.use
        return use.hold(locks) if isinstance(use, FleetUse) else all_held(locks)

    def _refuse_if_interrupted(self, name: str) -> None:
        """Raise after an interrupt: it is unknown what was sent, and which results are lost."""
        if self._sends or any(queue.interrupted for queue in self._queues):
            restart = self._queues[0].part.repository.policy.restart
            refused = refusal(State.PENDING, name, restart, "send or recv")
            assert refused is not None
            raise refused

    def _note(self) -> None:
        """Note whether something is in flight, so that other requests are refused."""
        self._order.waiting = SENT if self._is_pending() else None

    def _is_pending(self) -> bool:
        return bool(self._ready) or self._sends or any(queue.busy for queue in self._queues)

    # --- receiving -------------------------------------------------------------------------------

    @contextmanager
    def held_in_time(self, deadline: Deadline) -> Iterator[None]:
        """Hold the lock that another thread's ``recv`` may hold; raises as ``recv`` does."""
        lock, left_s, taken = self._order.use.flight, deadline.left_s(), False
        try:
            left_s = threading.TIMEOUT_MAX if left_s is None else min(left_s, threading.TIMEOUT_MAX)
            taken = lock.acquire(timeout=left_s)
            if not taken:
                raise _too_few(deadline)
            yield
        finally:
            if taken:
                lock.release()

    def recv(self, min_ready: int, timeout: float | Deadline | None) -> Received:
        """The results of the first sub-environments that are ready, at most one for each.
        Raises ``NoAsyncCallError``: nothing was sent; ``WorkerTimeoutError``: ``timeout`` passed,
        and nothing is lost, or a step took too long, as in ``Requests.collect_step``.
        """
        self._order.refuse_if_closed()
        if not self._is_pending():
            if self._order.waiting == SENT:  # an interrupt came before ``_note``
                self._note()
            raise NoAsyncCallError("Calling `recv` without any prior call to `send`.", "recv")
        self._refuse_if_interrupted("recv")
        self._refuse_fewer_than_come(min_ready)
        deadline = deadline_of(timeout)
        with self._held([queue for queue in self._queues if queue.busy]):
            try:
                while (taken := self._first(min_ready)) is None:
                    for worker in self._wait(deadline):
                        # an error is kept until earlier results were received
                        try:
                            self._queues[worker].take(partial(self._keep, worker))
                        except (EnvHubError, RemoteEnvWarning) as error:
                            if all(at != worker for at, _ in self._ready):
                                raise
                            self._keep(worker, error)
                return self._joined(taken)
            except Exception:
                self._order.refuse_if_closed()  # a signal handler may have closed it
                raise
            finally:
                self._note()

    def _refuse_fewer_than_come(self, min_ready: int) -> None:
        """Raise ``ValueError`` if one worker has all sub-environments: all are ready together."""
        [queue, *others] = self._queues
        if others or min_ready >= queue.count:
            return
        whole = f"one worker steps all {queue.count} sub-environments, so they are ready together"
        if not self._order.results.manifest.shardable:
            cure = "the repository's own vector class does so: wait for all of them, or use `step`"
        elif queue.part.repository.policy.restart == "transparent":
            cure = 'with `restart="transparent"` give make_env `min_ready`, and no `num_workers=1`'
        else:
            cure = "give make_env a larger `num_workers`, or `min_ready` and no `num_workers`"
        raise ValueError(f"`min_ready` is {min_ready}, but {whole}: {cure}. Nothing is lost")

    def _wait(self, deadline: Deadline) -> list[int]:
        """Sleep until workers have answered or are late; returns these. Raises at ``deadline``."""
        busy = [worker for worker, queue in enumerate(self._queues) if queue.busy]
        lanes = [self._queues[worker].lane for worker in busy]
        ended = [worker for worker, lane in zip(busy, lanes, strict=True) if lane is None]
        if ended:
            return ended
        lefts = [deadline.left_s(), *(self._queues[worker].left_s for worker in busy)]
        until = Deadline(min((left for left in lefts if left is not None), default=None))
        answered = answered_first([lane for lane in lanes if lane is not None], until)
        late = [at for at, worker in enumerate(busy) if self._queues[worker].left_s == 0]
        if not answered and not late and deadline.passed:
            raise _too_few(deadline)
        return [busy[at] for at in answered or late]

    def _keep(self, worker: int, result: StepResult | Exception) -> None:
        self._ready.append((worker, result))

    def _first(self, min_ready: int) -> dict[int, StepResult] | None:
        """The oldest result of each worker, until there are ``min_ready`` rows or none is owed;
        None if fewer are there and more are owed. Raises an error if it is a worker's oldest.
        """
        self._order.refuse_if_closed()
        oldest: dict[int, StepResult] = {}
        for entry in self._ready:
            worker, result = entry
            if worker in oldest:
                continue
            if isinstance(result, Exception):
                self._ready.remove(entry)
                raise result
            oldest[worker] = result
        owing = any(queue.busy for at, queue in enumerate(self._queues) if at not in oldest)
        taken: dict[int, StepResult] = {}
        rows = 0
        for worker, result in oldest.items():
            taken[worker] = result
            rows += self._queues[worker].count
            if rows >= min_ready:
                return taken
        return None if owing else taken

    def _joined(self, taken: dict[int, StepResult]) -> Received:
        """Join results into one batch, by ascending ids, and remove them from the ready ones."""
        places = sorted(taken)
        queues = [self._queues[worker] for worker in places]
        env_ids = np.concatenate([np.arange(*queue.rows) for queue in queues])
        results = [taken[worker] for worker in places]
        observations, rewards, terminations, truncations, infos = zip(*results, strict=True)
        if len(results) == 1:
            received = Received(*results[0], env_ids)
        else:
            sizes = [queue.count for queue in queues]
            received = Received(
                batches.join(self._space, observations),
                np.concatenate(rewards),
                np.concatenate(terminations),
                np.concatenate(truncations),
                gather_infos(infos, sizes, DEFAULT_LIMITS.message_bytes),
                env_ids,
            )
        self._ready = deque(entry for entry in self._ready if taken.get(entry[0]) is not entry[1])
        return received

    def drop(self) -> None:
        """Wait for the answers that are owed, and drop all results that were not received."""
        with self._held(self._queues):
            try:
                for queue in self._queues:
                    queue.drop()
                self._ready.clear()
                self._sends = False
            finally:
                self._note()


def _queues_of(parts: Sequence[EnvSession]) -> list[WorkerQueue]:
    """A queue for each worker, in the order of their sub-environments."""
    [part, *others] = parts
    # a restarted runner repeats the last request to all shards, so these share one queue
    if others or len(part.bounds) == 1 or part.repository.policy.restart == "transparent":
        return [WorkerQueue(part, part.rows, sliced=bool(others)) for part in parts]
    shards: list[ShardQueue] = []
    return [ShardQueue(part, shard, shards) for shard in range(len(part.bounds))]


def _too_few(deadline: Deadline) -> WorkerTimeoutError:
    return WorkerTimeoutError(
        f"fewer sub-environments than `min_ready` were ready after {deadline.timeout_s} s; "
        "nothing is lost: call `recv` again",
        request="recv",
        timeout_s=deadline.timeout_s,
    )

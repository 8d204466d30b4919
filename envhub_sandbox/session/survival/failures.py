"""What is told of a request that failed, and what is written down of it."""

from __future__ import annotations

from envhub_sandbox.crash.history import History
from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.log import WORKER
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.refusals import closed_during, expiry
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol.lifecycle import Event


class Failures:
    """Makes the errors of one environment out of what went wrong; it moves where they belong.

    Args:
        lease: Its jail.
        results: Its manifest and slices.
        counters: Of deaths and late replies.
        history: What was asked, for a crash bundle.
    """

    def __init__(
        self, lease: Lease, results: Results, counters: Counters, history: History
    ) -> None:
        self._lease = lease
        self._manifest = results.manifest
        self._shards = len(results.bounds)
        self._counters = counters
        self._history = history

    def late(self, operation: str, deadline: Deadline) -> WorkerTimeoutError:
        """The deadline came first."""
        timeout_s, states = deadline.timeout_s, self._lease.states()
        WORKER.info("%s: no answer to %s after %s s", self._label, operation, timeout_s)
        busy = f" (its processes: {', '.join(states)})" if states else ""
        error = WorkerTimeoutError(
            f"{operation} has not finished after {timeout_s} s{busy}; reset() brings the "
            "environment back, in a fresh process if it still does not answer",
            request=operation,
            timeout_s=timeout_s,
        )
        error.worker = states
        return error

    def expired(self, operation: str, why: str) -> WorkerDiedError:
        """The server has ended it, because nobody used it."""
        lifecycle = self._lease.lifecycle
        lifecycle.moved(Event.EXPIRY)
        lifecycle.request = None
        return expiry(operation, why)

    def dead(self, error: EnvHubError) -> EnvHubError:
        """A death, or a lie; what closed an environment under its user is told as such.

        Whoever has not died, or has a jail that goes on without him, lives still, and cannot be
        trusted to do what he says: the jail is ended.
        """
        lifecycle, lease = self._lease.lifecycle, self._lease
        operation = lifecycle.request or "a request"
        if lifecycle.closed:
            return closed_during(operation)
        self._counters.deaths += 1
        lifecycle.moved(Event.DEATH)
        WORKER.info("%s: %s", self._label, str(error).partition("\n")[0])
        died = isinstance(error, WorkerDiedError)
        try:
            lease.note_denied(error)
        finally:
            if lease.loaded is not None and (lease.loaded.jail.kept or not died):
                lease.end()
        if isinstance(error, WorkerDiedError):
            self._write_crash(error)  # asked once: a server that says nothing takes its time
        return error

    def keep_crash(self, error: WorkerDiedError | WorkerTimeoutError) -> None:
        """Write a crash bundle, and name it in the error."""
        self._lease.note_denied(error)
        self._write_crash(error)

    def _write_crash(self, error: WorkerDiedError | WorkerTimeoutError) -> None:
        lease, manifest = self._lease, self._manifest
        task = {
            "suite": manifest.suite,
            "task": manifest.task,
            "num_envs": manifest.num_envs,
            "shards": self._shards,
            "lane": None if lease.lane is None else lease.lane.name,
        }
        recording, loaded = self._history.recording(), lease.loaded
        lease.repository.keep_crash(error, recording, task, loaded, shared=lease.shared)

    @property
    def _label(self) -> str:
        return self._lease.repository.label

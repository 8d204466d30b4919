"""Failures of requests: the error for the caller, the crash bundle, the lifecycle's move."""

from __future__ import annotations

from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.session.crash.history import History
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.survival.refusals import closed_during, expiry
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol.lifecycle import Event


class Failures:
    """The failures of one environment's requests.
    ``interruption``: the request whose wait was interrupted, so that its reply is late; None where
    the last late reply has another reason.
    """

    def __init__(self, lease: Lease, history: History) -> None:
        self._lease = lease
        self._counters = lease.counters
        self._label = lease.repository.label
        self._history = history
        self.interruption: str | None = None

    def timed_out(self, operation: str, deadline: Deadline) -> WorkerTimeoutError:
        """The deadline of a request came first: the environment is LATE."""
        self._counters.timeouts += 1
        self.interruption = None
        self._lease.lifecycle.moved(Event.TIMEOUT)
        return self.late(operation, deadline)

    def interrupted(self, error: BaseException) -> None:
        """Ctrl-C, or another exception of a signal handler, ended a wait.

        The reply may still come, so the environment is LATE, and not READY.
        Raises ``WorkerDiedError``: a ``close`` within the wait took away what was waited for.
        """
        if self._lease.lifecycle.closed and isinstance(error, Exception):
            raise self.dead(WorkerDiedError("")) from error
        self.note_interruption()

    def note_interruption(self) -> None:
        """The reply to the pending request is late, for that reason."""
        self.interruption = self._lease.lifecycle.request or "request"
        self._lease.lifecycle.moved(Event.INTERRUPT)

    def late(self, operation: str, deadline: Deadline) -> WorkerTimeoutError:
        """The error for a reply that did not come in time."""
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
        """The server has ended the jail because it was idle."""
        lifecycle = self._lease.lifecycle
        lifecycle.moved(Event.EXPIRY)
        lifecycle.request = None
        return expiry(operation, why)

    def dead(self, error: EnvHubError) -> EnvHubError:
        """The jail has died, or broke a rule of the protocol: the environment is DEAD.

        A jail that still lives is ended: after a broken rule, and where it goes on without the
        runner that has died.

        Returns:
            The error for the caller; after a ``close`` it says that the environment was closed.
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
            self._write_crash(error)  # denials are asked for once: a silent server costs 10 s
        return error

    def keep_crash(self, error: WorkerDiedError | WorkerTimeoutError) -> None:
        """Write a crash bundle, and name it in the error."""
        self._lease.note_denied(error)
        self._write_crash(error)

    def _write_crash(self, error: WorkerDiedError | WorkerTimeoutError) -> None:
        lease, results = self._lease, self._lease.results
        manifest = results.manifest
        task = {
            "suite": manifest.suite,
            "task": manifest.task,
            "num_envs": manifest.num_envs,
            "shards": len(results.bounds),
            "lane": None if lease.lane is None else lease.lane.name,
        }
        recording, loaded = self._history.recording(), lease.loaded
        lease.repository.keep_crash(error, recording, task, loaded, shared=lease.shared)

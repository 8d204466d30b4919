"""Failures of requests: makes the caller's error, writes a crash bundle, and moves the state.

``refusal`` is the error of a request that the state does not permit; ``Restarts`` bounds how often
and how soon a dead worker is replaced.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.lease import Lease, closed_during
from envhub_sandbox.session.recorder import Recorder
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.platform import fork_error_text
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, State

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import Request

_CALM_S = 60.0
_LONGEST_S = 30.0
_LOOK_AGAIN_S = 0.1


def expiry(operation: str, why: str) -> WorkerDiedError:
    """The error of a request to an environment whose jail ended because it was idle."""
    text = f"cannot {operation}: {why}, so its processes were ended; call reset() first"
    return WorkerDiedError(text, reason="idle", request=operation, detail=why)


def refusal(
    state: State, operation: str, restart: str, interrupted: str | None = None
) -> EnvHubError | None:
    """The error of a request that the environment's state does not permit, or None.

    ``restart`` is the policy's; ``interrupted`` is the request whose wait was interrupted.
    """
    if state in (State.IDLE, State.READY):
        return None
    if state in (State.LATE, State.PENDING) and interrupted is not None:
        text = (
            f"cannot {operation}: the last {interrupted} was interrupted, by Ctrl-C or a stopped "
            "cell, so the state of the environment is unknown; call reset() first"
        )
        return WorkerTimeoutError(text, request=operation)
    if state in (State.LATE, State.PENDING):
        text = f"cannot {operation}: the reply to the last request is late; call reset() first"
        return WorkerTimeoutError(text, request=operation)
    if state is State.DEAD:
        once = f"make the environment again, or use {option_name('restart', 'on_reset')} and call"
        cure = "call reset() first" if restart != "never" else f"{once} reset()"
        text = f"cannot {operation}: the worker process has died; {cure}"
        return WorkerDiedError(text, request=operation)
    if state is State.EXPIRED:
        return expiry(operation, "it was idle for too long")
    if state is State.FOREIGN:
        return WorkerError(f"cannot {operation}: {fork_error_text()}")
    if state is State.CLOSED:
        return closed_during(operation)
    return WorkerError(f"cannot {operation}: the environment is {state.value}")


class Restarts:
    """Permits and delays the restarts of one environment; its counters count them."""

    def __init__(self, policy: Policy, counters: Counters) -> None:
        self._policy = policy
        self._counters = counters
        self._last = -_CALM_S  # when the last restart was; long ago
        self._in_a_row = 0  # restarts in short succession
        self._given_up = False  # the environment was closed

    @property
    def permitted(self) -> bool:
        """Whether the policy permits restarts."""
        return self._policy.restart != "never"

    def give_up(self) -> None:
        """Soon end the wait for a restart in another thread."""
        # interruption.md, rule 12: an Event has a lock, which this very thread may hold
        self._given_up = True

    def spend(self, operation: str) -> None:
        """Count a restart, after a pause if the last restart was less than a minute ago.
        Raises ``WorkerDiedError``: no restarts are left, or the environment was closed.
        """
        budget = self._policy.restart_budget
        if self._counters.restarts >= budget:
            raise WorkerDiedError(
                f"the worker process has died again, and all {budget} restarts are used up "
                "(restart_budget of the policy); make the environment again",
                request=operation,
            )
        calm = time.monotonic() - self._last >= _CALM_S
        self._in_a_row = 0 if calm else self._in_a_row + 1
        until = time.monotonic() + backoff_s(self._policy.restart_backoff_s, self._in_a_row)
        while not self._given_up and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, _LOOK_AGAIN_S))
        if self._given_up:
            raise closed_during(operation)
        self._last = time.monotonic()
        self._counters.restarts += 1


def backoff_s(first_s: float, in_a_row: int) -> float:
    """The seconds to wait before a restart that follows ``in_a_row`` others in short succession."""
    if in_a_row == 0:
        return 0.0
    return min(first_s * 2.0 ** min(in_a_row - 1, 64), _LONGEST_S)


class Failures:
    """Handles the failures of one environment's requests.
    ``interruption``: the request whose reply is late because its wait was interrupted, or None.
    """

    def __init__(self, lease: Lease, recorder: Recorder) -> None:
        self._lease = lease
        self._counters = lease.counters
        self._label = lease.repository.label
        self._recorder = recorder
        self.interruption: str | None = None

    def timed_out(self, operation: str, deadline: Deadline) -> WorkerTimeoutError:
        """Move to LATE, since a request's deadline has passed; returns the error."""
        self._counters.timeouts += 1
        self.interruption = None
        self._lease.lifecycle.moved(Event.TIMEOUT)
        return self.late(operation, deadline)

    def interrupted(self, error: BaseException) -> None:
        """Move to LATE, since an exception of a signal handler, such as a Ctrl-C, ended a wait.

        It is not READY, because the reply may still come.
        Raises ``WorkerDiedError``: a ``close`` during the wait has ended the jail.
        """
        if self._lease.lifecycle.closed and isinstance(error, Exception):
            raise self.dead(WorkerDiedError("")) from error
        self.note_interruption()

    def note_interruption(self) -> None:
        """Note that the pending request's reply is late because its wait was interrupted."""
        self.interruption = self._lease.lifecycle.request or "request"
        self._lease.lifecycle.moved(Event.INTERRUPT)

    def late(self, operation: str, deadline: Deadline) -> WorkerTimeoutError:
        """The error for a reply that did not come in time."""
        timeout_s, states = deadline.timeout_s, self._lease.states()
        WORKER.info("%s: no answer to %s after %s s", self._label, operation, timeout_s)
        busy = f" (its processes: {', '.join(states)})" if states else ""
        option = f"{operation}_s" if operation in ("reset", "step") else "call_s"
        longer = ""
        if timeout_s and timeout_s == getattr(self._lease.repository.timeouts, option):
            longer = f"; {option_name(option, 2 * timeout_s)} waits longer"
        error = WorkerTimeoutError(
            f"{operation} has not finished after {timeout_s} s{busy}; reset() brings the "
            f"environment back, in a fresh process if it still does not answer{longer}",
            request=operation,
            timeout_s=timeout_s,
        )
        error.worker = states
        return error

    def expired(self, operation: str, why: str) -> WorkerDiedError:
        """Move to EXPIRED, since the server has ended an idle jail; returns the error."""
        lifecycle = self._lease.lifecycle
        lifecycle.moved(Event.EXPIRY)
        lifecycle.request = None
        return expiry(operation, why)

    def dead(self, error: EnvHubError) -> EnvHubError:
        """Move to DEAD, since the jail has died or violated the protocol.

        A jail that still lives is ended. Returns the error for the caller; after a ``close`` it
        says that the environment was closed.
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
            # Before the jail is ended: its server forgets the denials with it.
            lease.note_denied(error)
        finally:
            if lease.loaded is not None and (lease.loaded.jail.kept or not died):
                lease.end()
        if isinstance(error, WorkerDiedError):
            self._write_crash(error)  # not keep_crash: asking a silent server again would cost 10 s
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
            "single": results.single,
            "lane": None if lease.lane is None else lease.lane.name,
        }
        loaded = lease.loaded
        of_jail = () if loaded is None else (loaded.manifest, loaded.jail.report)
        lease.repository.keep_crash(error, self._recorder, task, *of_jail)


class Recovery(Protocol):
    """Completes a request although shards have died in it: see ``extras/restart``."""

    def started(self) -> None:
        """Note that the jail is new."""

    def sent(self, request: Request) -> None:
        """Note a request that was sent."""

    def answered(self) -> None:
        """Note that no shard has raised in it."""

    def deaths_of_all(self, error: WorkerError) -> RunnersDiedError:
        """Treat the end of the jail as the death of all shards."""

    def survive_request(self, deaths: RunnersDiedError) -> list[m.Message]:
        """The replies to a reset. Raises ``WorkerDiedError``: the request was another."""

    def survive_step(self, deaths: RunnersDiedError) -> list[m.StepDone]:
        """The replies to a step, with truncated rows for the dead shards."""

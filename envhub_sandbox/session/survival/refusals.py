"""Why an environment takes no request now: it was closed, has died, is late, or is of a fork."""

from __future__ import annotations

from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.processes import fork_error_text
from envhub_worker.protocol.lifecycle import State


def closed_during(operation: str) -> WorkerDiedError:
    """The error of a request during which the environment was closed."""
    text = f"the environment was closed during {operation}"
    return WorkerDiedError(text, reason="killed", request=operation)


def expiry(operation: str, why: str) -> WorkerDiedError:
    """The error of an environment that was idle for too long."""
    text = f"cannot {operation}: {why}, so its processes were ended; call reset() first"
    return WorkerDiedError(text, reason="idle", request=operation, detail=why)


def refusal(
    state: State, operation: str, restart: str, interrupted: str | None = None
) -> EnvHubError | None:
    """Why an environment takes no request now; None if it takes one.

    ``restart`` is the policy's; ``interrupted`` the request whose wait was interrupted.
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
        text = f"cannot {operation}: the worker process has died; {_advice(restart)}"
        return WorkerDiedError(text, request=operation)
    if state is State.EXPIRED:
        return expiry(operation, "it was idle for too long")
    if state is State.FOREIGN:
        return WorkerError(f"cannot {operation}: {fork_error_text()}")
    if state is State.CLOSED:
        return closed_during(operation)
    return WorkerError(f"cannot {operation}: the environment is {state.value}")


def _advice(restart: str) -> str:
    if restart != "never":
        return "call reset() first"
    return (
        f"make the environment again, or use {option_name('restart', 'on_reset')} and call reset()"
    )

"""When a place takes no worker: whether another may, and what is said where none does."""

from __future__ import annotations

from collections.abc import Sequence

from envhub_sandbox.errors import (
    EnvHubError,
    ServerBusyError,
    WorkerDiedError,
    WorkerStartupError,
    WorkerTimeoutError,
)
from envhub_sandbox.transport.tcp import UnreachableError


def may_go_elsewhere(error: EnvHubError) -> bool:
    """Whether another place is worth a try: this one has no room, or is not there.

    What the repository does would be the same elsewhere, and a key that is refused is a mistake
    that has to be known.
    """
    if isinstance(error, WorkerDiedError):
        return error.reason in ("connection", "server")
    if isinstance(error, WorkerTimeoutError):
        return error.request is None
    return isinstance(error, (ServerBusyError, UnreachableError, WorkerStartupError))


def worst_of(failures: Sequence[EnvHubError]) -> EnvHubError:
    """The error for a worker that no place takes: one that may pass first; the text has all.

    ``failures``: at least one, in the order of the tries.
    """
    busy = (one for one in failures if isinstance(one, ServerBusyError))
    error = next(busy, failures[0])
    others = [str(one).partition("\n")[0] for one in failures if one is not error]
    if others and error.args:
        more = "\n".join(["The other places of the fleet:", *others])
        error.args = (f"{error.args[0]}\n{more}", *error.args[1:])
    return error

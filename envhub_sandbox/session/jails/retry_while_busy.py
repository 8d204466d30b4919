"""Waiting for a server that has no room at present."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic, sleep
from typing import TypeVar

from envhub_sandbox.errors import EnvHubError, ServerBusyError, WorkerDiedError
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.tcp import UnreachableError
from envhub_worker.protocol.messages.busy import DRAINING

_SOON_S = 0.1
_SLICE_S = 0.1
_AGAIN_S = 1.0
T = TypeVar("T")


def retry_while_busy(
    ask: Callable[[], T],
    retry_s: float,
    deadline: Deadline,
    label: str,
    refusal: EnvHubError | None = None,
) -> T:
    """Ask, and ask again while the answer is that there is no room.

    The server keeps the order of those who go on asking: so the second time is soon, and takes the
    place in the line. The time in the line does not count against the deadline.

    Args:
        deadline: For all else; once it is given up, the waiting ends.
        refusal: The answer to an earlier try.

    Raises:
        ServerBusyError: There was no room in all that time.
    """
    until, pause_s = monotonic() + retry_s, _SOON_S
    ends = refusal is not None and (is_draining(refusal) or is_unanswered(refusal))
    while True:
        try:
            return ask()
        except (ServerBusyError, WorkerDiedError, UnreachableError) as error:
            left_s = until - monotonic()
            ends = ends or is_draining(error)
            worth_it = isinstance(error, ServerBusyError) or (ends and is_unanswered(error))
            if left_s <= 0 or deadline.unasked or not worth_it:
                raise
            if pause_s == _SOON_S:
                WORKER.warning("%s: %s; waiting for up to %.0f s", label, error, left_s)
            _pause(min(pause_s, left_s), deadline)
            pause_s = max(getattr(error, "retry_s", _AGAIN_S), _SLICE_S * 2)


def is_draining(error: EnvHubError) -> bool:
    """Whether another in its place is worth waiting for."""
    return isinstance(error, ServerBusyError) and error.quota == DRAINING


def is_unanswered(error: EnvHubError) -> bool:
    """Whether there was no answer, so that it may have been between two servers."""
    if isinstance(error, WorkerDiedError):
        return error.reason == "connection"
    return isinstance(error, UnreachableError)


def _pause(pause_s: float, deadline: Deadline) -> None:
    until = monotonic() + pause_s
    while not deadline.unasked and (left_s := until - monotonic()) > 0:
        sleep(min(left_s, _SLICE_S))
    deadline.postpone(pause_s)

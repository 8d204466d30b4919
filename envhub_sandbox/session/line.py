"""Waiting for a server that has no room at present."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic, sleep
from typing import TypeVar

from envhub_sandbox.errors import ServerBusyError
from envhub_sandbox.log import WORKER
from envhub_sandbox.transport.deadline import Deadline

_SOON_S = 0.1
_SLICE_S = 0.1
T = TypeVar("T")


def wait_in_line(ask: Callable[[], T], retry_s: float, deadline: Deadline, label: str) -> T:
    """Ask, and ask again while the answer is that there is no room.

    The server keeps the order of those who go on asking: so the second time is soon, and takes the
    place in the line. The time in the line does not count against the deadline.

    Args:
        ask: Asks once.
        retry_s: For how long.
        deadline: For all else; whoever gives it up is waited for no more.
        label: For whom, in the log.

    Raises:
        ServerBusyError: There was no room in all that time.
    """
    until, pause_s = monotonic() + retry_s, _SOON_S
    while True:
        try:
            return ask()
        except ServerBusyError as busy:
            left_s = until - monotonic()
            if left_s <= 0 or deadline.unasked:
                raise
            if pause_s == _SOON_S:
                WORKER.warning("%s: %s; waiting for up to %.0f s", label, busy, left_s)
            _pause(min(pause_s, left_s), deadline)
            pause_s = max(busy.retry_s, _SLICE_S * 2)


def _pause(pause_s: float, deadline: Deadline) -> None:
    until = monotonic() + pause_s
    while not deadline.unasked and (left_s := until - monotonic()) > 0:
        sleep(min(left_s, _SLICE_S))
    deadline.postpone(pause_s)

"""Whether somebody else is using an environment at this moment: looked for only after a collision.

A note of the thread in each step would cost every step; the stacks of all threads are there anyway.
"""

from __future__ import annotations

import sys
import threading
from types import FrameType

from gymnasium.error import AlreadyPendingCallError


def collision(session: object, operation: str) -> AlreadyPendingCallError | None:
    """The error for a request in the midst of another thread's; None if no thread is at one."""
    own, names = threading.get_ident(), {one.ident: one.name for one in threading.enumerate()}
    for ident, frame in sys._current_frames().items():
        if ident != own and _uses(frame, session):
            return AlreadyPendingCallError(
                f"cannot {operation}: thread {names.get(ident, ident)!r} is using this environment "
                "at the same time, and it is for one thread at a time: hold a lock around its use, "
                "or make one for each thread",
                operation,
            )
    return None


def _uses(innermost: FrameType, session: object) -> bool:
    """Whether a method of it, or of what has it, is being executed."""
    frame: FrameType | None = innermost
    while frame is not None:
        name = frame.f_globals.get("__name__", "")
        if name.startswith(_OURS) and frame.f_code.co_name != "close":
            own = frame.f_locals.get("self")
            if own is session or getattr(own, "__dict__", {}).get("_remote") is session:
                return True
        frame = frame.f_back
    return False


_OURS = ("envhub_sandbox.session.env_session", "envhub_sandbox.vector.")

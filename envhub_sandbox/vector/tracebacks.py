"""Short tracebacks: removes our own frames from errors whose text says what went wrong.

An error of the repository ends with its author's line, and an error about an argument names the
argument. A dozen frames of this package would hide the caller's line and that text. So only the
caller's frames stay, and one frame of ours, which raises the error again. ``ENVHUB_TRACEBACK=full``
keeps all frames; the logger ``envhub_sandbox.errors`` shows them at DEBUG.
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable
from types import TracebackType
from typing import ParamSpec, TypeVar

from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, WorkerError
from envhub_sandbox.system.log import ERRORS
from envhub_worker.protocol.text import shortage

_VARIABLE, _FULL = "ENVHUB_TRACEBACK", "full"
_SHORT = 3
"""The most frames of an error that was shortened before and passes another of our methods."""
_CHAINED = 20
RAISED = (EnvHubError, AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError)
"""What an environment raises by itself."""
P = ParamSpec("P")
T = TypeVar("T")


def shortened(error: BaseException) -> bool:
    """Remove the frames of an error; returns whether, so that the caller raises it again.

    Protocol errors and errors of other packages keep their frames, which say where to look.
    """
    if not _text_suffices(error) or os.environ.get(_VARIABLE) == _FULL:
        return False
    if ERRORS.isEnabledFor(logging.DEBUG) and _depth(error.__traceback__) > _SHORT:
        ERRORS.debug("the whole traceback of what is raised", exc_info=error)
    _shorten_causes(error)
    error.__traceback__ = None
    return True


def short_traceback(ask: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that its errors have only the caller's frames and one of ours.

    ``EMFILE``, ``ENOMEM`` and the like are raised as a ``WorkerError``.
    """

    @functools.wraps(ask)
    def asked(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return ask(*args, **kwargs)
        except RAISED as error:
            if not shortened(error):
                raise
            __tracebackhide__ = True  # pytest hides the frame then
            raise error  # ENVHUB_TRACEBACK=full shows where
        except Exception as error:
            short = shortage(error, "here")
            if not short:
                raise
            raise WorkerError(short) from error

    return asked


def _text_suffices(error: BaseException) -> bool:
    return isinstance(error, RAISED) and not isinstance(error, RemoteProtocolError)


def _shorten_causes(error: BaseException) -> None:
    """Remove the frames of the causes of an error that are errors of this project."""
    cause = error.__cause__
    for _ in range(_CHAINED):
        if cause is None:
            return
        if _text_suffices(cause):
            cause.__traceback__ = None
        cause = cause.__cause__


def _depth(traceback: TracebackType | None) -> int:
    depth = 0
    while traceback is not None:
        traceback, depth = traceback.tb_next, depth + 1
    return depth

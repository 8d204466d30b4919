"""Leaves our own frames out of the traceback of an error that says by itself where it comes from.

What a repository raises ends in its author's line, and what is wrong with what was asked for is in
the text. A dozen frames of this package between the caller's line and that text hide both: what is
left is the caller's frames and the one that raises it again. ``ENVHUB_TRACEBACK=full`` leaves all
of them, and the logger ``envhub_sandbox.errors`` has them at DEBUG.
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable
from types import TracebackType
from typing import ParamSpec, TypeVar

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, WorkerError
from envhub_sandbox.log import ERRORS
from envhub_worker.protocol.shortages import shortage

_VARIABLE, _FULL = "ENVHUB_TRACEBACK", "full"
_FOLDED = 3
"""As many frames are left where what was folded comes through another method of ours."""
_CHAINED = 20
P = ParamSpec("P")
T = TypeVar("T")


def folds(error: BaseException) -> bool:
    """Whether it is to be raised again: its frames are told of then, and it has none any more.

    A broken rule of the wire keeps them, and so does whatever is no error of this project: there,
    the frames are what is known.
    """
    if not _tells_where(error) or os.environ.get(_VARIABLE) == _FULL:
        return False
    if ERRORS.isEnabledFor(logging.DEBUG) and _depth(error.__traceback__) > _FOLDED:
        ERRORS.debug("the whole traceback of what is raised", exc_info=error)
    _fold_causes(error)
    error.__traceback__ = None
    return True


def folded(ask: Callable[P, T]) -> Callable[P, T]:
    """The same function, whose errors have the caller's frames and one of ours.

    What the machine has no more of becomes an error of this project, wherever it was needed.
    """

    @functools.wraps(ask)
    def asked(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return ask(*args, **kwargs)
        except EnvHubError as error:
            if not folds(error):
                raise
            __tracebackhide__ = True  # pytest hides the frame then
            raise error  # ENVHUB_TRACEBACK=full shows where
        except Exception as error:
            short = shortage(error, "here")
            if not short:
                raise
            raise WorkerError(short) from error

    return asked


def _tells_where(error: BaseException) -> bool:
    return isinstance(error, EnvHubError) and not isinstance(error, RemoteProtocolError)


def _fold_causes(error: BaseException) -> None:
    """What it was made of, as far as that is ours, has its text; others' errors stay whole."""
    cause = error.__cause__
    for _ in range(_CHAINED):
        if cause is None:
            return
        if _tells_where(cause):
            cause.__traceback__ = None
        cause = cause.__cause__


def _depth(traceback: TracebackType | None) -> int:
    depth = 0
    while traceback is not None:
        traceback, depth = traceback.tb_next, depth + 1
    return depth

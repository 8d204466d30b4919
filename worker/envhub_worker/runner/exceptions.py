"""Turns an exception of the repository into text."""

from __future__ import annotations

import builtins
import traceback

from envhub_worker.protocol.messages import Raised
from envhub_worker.protocol.text import printable
from envhub_worker.unreadable import why_hidden

_MAX_MESSAGE = 8_192
_MAX_TRACEBACK = 32_768
_GYMNASIUM = "gymnasium.error"
_OURS = f"{__name__.rpartition('.')[0]}."


def raised(error: BaseException, stage: str) -> Raised:
    """The message for an exception: its nearest builtin ancestor, its text, its traceback."""
    # a package that may not be read is imported all the same, as one without a file of its own
    nowhere = isinstance(error, ImportError) and error.path is None
    hidden = why_hidden(str(getattr(error, "name", ""))) if nowhere else ""
    if hidden:
        denied = PermissionError(f"{_text(error)}, but {hidden}")
        error = denied.with_traceback(error.__traceback__)
    kind = type(error)
    name = kind.__qualname__
    if kind.__module__ not in ("builtins", "__main__"):
        name = f"{kind.__module__}.{name}"
    return Raised(
        builtin=_builtin(kind),
        type_name=printable(name, 512),
        message=printable(_text(error), _MAX_MESSAGE),
        traceback=printable(_traceback(error), _MAX_TRACEBACK),
        stage=stage,
    )


def _builtin(kind: type[BaseException]) -> str:
    """Its nearest builtin ancestor that says anything, or else its nearest one of Gymnasium's."""
    own = [base for base in kind.__mro__ if getattr(builtins, base.__name__, None) is base]
    theirs = [base for base in kind.__mro__ if base.__module__ == _GYMNASIUM]
    if theirs and own and own[0] is Exception:
        return f"{_GYMNASIUM}.{theirs[0].__name__}"
    return str(own[0].__name__) if own else "Exception"


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:
        return "(its text could not be read)"


def _traceback(error: BaseException) -> str:
    """The traceback, without the frames of this package that called into the repository."""
    frames = error.__traceback__
    while frames and frames.tb_frame.f_globals.get("__name__", "").startswith(_OURS):
        frames = frames.tb_next
    try:
        return "".join(
            traceback.format_exception(type(error), error, frames or error.__traceback__)
        )
    except Exception:
        return ""

"""Ctrl-C at a moment that is chosen, and not met by luck."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import envhub_sandbox

_OURS = str(Path(envhub_sandbox.__file__).parent)


def before_line(file: str | None, line: int, act: Callable[[], object]) -> bool:
    """Do it, with a Ctrl-C before the ``line``-th line that runs in a file; whether one came."""
    return _at(line, "line", lambda name: name == file, act)


def at_call(moment: int, act: Callable[[], object]) -> bool:
    """Do it, with a Ctrl-C at the ``moment``-th call of the client's own; whether one came.
    Python looks for signals where a function begins. One that comes into a finaliser is printed,
    and goes no further."""
    return _at(moment, "call", lambda name: name.startswith(_OURS), act)


def _at(moment: int, wanted: str, ours: Callable[[str], bool], act: Callable[[], object]) -> bool:
    left = moment

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal left
        if not ours(frame.f_code.co_filename):
            return None
        if event == wanted:
            left -= 1
            if left < 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return trace if wanted == "line" else None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        act()
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(before)
    return left < 0

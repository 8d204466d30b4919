"""``ENVHUB_TRACE=1``: print each message to and from a worker to stderr, with its time.

    +0.004210 MainThread > WorkerConnection.send OpenJail
    +0.052377 MainThread < WorkerConnection.receive JailOpened (48.1 ms)

A line names classes of messages and operations, and never a value. Without the variable no class is
changed, so a step costs the same.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable
from time import perf_counter
from typing import Any

from envhub_worker.protocol import messages as m

_SENDING = frozenset({"send_step", "send", "send_for_infos"})
_WAITING = frozenset({"wait", "replies", "receive"})


@functools.cache
def start() -> None:
    """Print from now on."""
    # sandboxes/process.py says why they are imported late
    from envhub_sandbox.transport.connection import WorkerConnection
    from envhub_sandbox.transport.lane import Lane
    from envhub_sandbox.transport.shared_memory.served_lane import ServedLane

    began = perf_counter()

    def say(text: str) -> None:
        passed_s = perf_counter() - began
        sys.stderr.write(f"+{passed_s:.6f} {threading.current_thread().name} {text}\n")

    classes: list[type] = [WorkerConnection, Lane, ServedLane]
    if sys.platform == "linux":
        from envhub_sandbox.transport.shared_memory.lane import SharedMemoryLane

        classes.append(SharedMemoryLane)
    for cls in classes:
        for name, method in list(vars(cls).items()):
            if name in _SENDING:
                setattr(cls, name, _sending(method, say))
            elif name in _WAITING:
                setattr(cls, name, _waiting(method, say))


def _sending(method: Callable[..., Any], say: Callable[[str], None]) -> Callable[..., Any]:
    @functools.wraps(method)
    def sending(self: Any, *args: Any, **kwargs: Any) -> Any:
        say(f"> {method.__qualname__} {' '.join(filter(None, map(_named, args)))}".rstrip())
        return method(self, *args, **kwargs)

    return sending


def _waiting(method: Callable[..., Any], say: Callable[[str], None]) -> Callable[..., Any]:
    @functools.wraps(method)
    def waiting(self: Any, *args: Any, **kwargs: Any) -> Any:
        began, what = perf_counter(), ""
        try:
            result = method(self, *args, **kwargs)
            what = _named(result)
        except BaseException as error:
            what = type(error).__name__
            raise
        finally:
            passed_ms = (perf_counter() - began) * 1e3
            say(f"< {method.__qualname__} {what} ({passed_ms:.3f} ms)".replace("  ", " "))
        return result

    return waiting


def _named(value: Any) -> str:
    """The classes of messages in it, and what a request is called."""
    if hasattr(value, "messages"):  # a request
        return f"{value.operation} {_named(value.messages)}"
    if isinstance(value, m.Message):
        operation = getattr(value, "operation", None)
        return f"{type(value).__name__} {operation}" if operation else type(value).__name__
    if isinstance(value, (list, tuple)):
        return " ".join(filter(None, map(_named, value)))
    return ""

"""``--deadline``: an alarm that interrupts a judgement, whatever it waits for.

It comes as a Ctrl-C does, which everything here can be interrupted by: a download, an installation,
a parser, a jail that hangs. What closes after it is interrupted too if it takes long. A call that
obeys no signal, such as one to a name server, is waited for. Windows has no alarm: there a thread
does what a Ctrl-C does.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator

_AGAIN_S = 15.0
"""After which what the alarm ended, and is still closing, is interrupted again."""


class DeadlineReached(KeyboardInterrupt):
    """The time for a judgement is over."""


@contextlib.contextmanager
def deadline_alarm(seconds: float) -> Iterator[None]:
    """Raise ``DeadlineReached`` in the main thread if this is not over after so many seconds."""
    over = reached = False

    def ring() -> None:
        nonlocal reached
        if not over:
            reached = True
            raise DeadlineReached

    with _alarm(seconds, ring):
        try:
            yield
        except Exception as error:
            if reached:  # what was interrupted has made another error of it
                raise DeadlineReached from error
            raise
        finally:
            over = True


@contextlib.contextmanager
def _alarm(seconds: float, ring: Callable[[], None]) -> Iterator[None]:
    """Call ``ring`` in the main thread after so many seconds, and again and again."""
    if sys.platform != "win32":
        left = threading.Event()

        def rung(*_: object) -> None:
            if not left.is_set():
                signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)  # also where another has sent it
            ring()

        before = signal.signal(signal.SIGALRM, rung)
        try:
            signal.setitimer(signal.ITIMER_REAL, seconds)
            yield
        finally:
            left.set()
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
    else:
        left, due = threading.Event(), threading.Event()
        keys = signal.getsignal(signal.SIGINT)

        def wait() -> None:
            pause_s = seconds
            while not left.wait(pause_s):
                pause_s = _AGAIN_S
                due.set()
                _thread.interrupt_main()

        def interrupted(number: int, frame: object) -> None:
            if due.is_set():
                due.clear()
                ring()
            else:
                signal.default_int_handler(number, None)

        signal.signal(signal.SIGINT, interrupted)
        try:
            threading.Thread(target=wait, daemon=True).start()
            yield
        finally:
            left.set()
            signal.signal(signal.SIGINT, keys)

"""``--deadline``: an alarm that interrupts a judgement.

The alarm acts like Ctrl-C, which interrupts everything here: a download, an installation, a parser,
a hanging jail. A second alarm interrupts a slow cleanup. A call that obeys no signal, such as a
query to a name server, delays the alarm. Windows has no alarm: there a thread simulates
Ctrl-C.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator

_AGAIN_S = 15.0
"""The time after which another alarm interrupts a slow cleanup."""


class DeadlineReached(KeyboardInterrupt):
    """The time for a judgement is over."""


@contextlib.contextmanager
def deadline_alarm(seconds: float) -> Iterator[None]:
    """Raise ``DeadlineReached`` in the main thread if the body runs longer than ``seconds``."""
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
            if reached:  # the interrupted code has turned the alarm into another error
                raise DeadlineReached from error
            raise
        finally:
            over = True


@contextlib.contextmanager
def _alarm(seconds: float, ring: Callable[[], None]) -> Iterator[None]:
    """Call ``ring`` in the main thread after ``seconds``, and then repeatedly."""
    if sys.platform != "win32":
        left = threading.Event()

        def rung(*_: object) -> None:
            if not left.is_set():
                signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)  # also after another's signal
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

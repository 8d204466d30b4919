"""``--deadline``: an alarm that interrupts a judgement, whatever it waits for.

It comes as a Ctrl-C does, which everything here can be interrupted by: a download, an installation,
a parser, a jail that hangs. What closes after it is interrupted too if it takes long. A call that
obeys no signal, such as one to a name server, is waited for.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

_AGAIN_S = 15.0
"""After which what the alarm ended, and is still closing, is interrupted again."""


class DeadlineReached(KeyboardInterrupt):
    """The time for a judgement is over."""


@contextlib.contextmanager
def deadline_alarm(seconds: float) -> Iterator[None]:
    """Raise ``DeadlineReached`` in the main thread if this is not over after so many seconds."""
    over = reached = False

    def ring(*_: object) -> None:
        nonlocal reached
        if not over:
            reached = True
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
            raise DeadlineReached

    before = signal.signal(signal.SIGALRM, ring)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        yield
    except Exception as error:
        if reached:  # what was interrupted has made another error of it
            raise DeadlineReached from error
        raise
    finally:
        over = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)

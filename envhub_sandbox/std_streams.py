"""The standard streams, where a program was started without them: ``<&- >&- 2>&-``."""

from __future__ import annotations

import os
import sys

_NUMBERS = 3


def occupy() -> None:
    """See to it that the numbers 0, 1 and 2 are taken.

    Else our first sockets and pipes would have them: what anybody prints would go to a worker, and
    what a worker is handed would be closed there in favour of its own standard streams.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) < _NUMBERS:  # the lowest that is free
        os.set_inheritable(null, True)
    os.close(null)


def replace_missing() -> None:
    """Occupy the numbers, and let ``print`` and others find a stream: for a program of ours."""
    occupy()
    sys.stdin = sys.stdin or open(os.devnull)  # noqa: SIM115
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115

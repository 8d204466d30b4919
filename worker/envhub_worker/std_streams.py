"""The standard streams, where a program was started without them: ``<&- >&- 2>&-``."""

from __future__ import annotations

import os
import sys

_NUMBERS = 3


def replace_missing() -> None:
    """See to it that the numbers 0, 1 and 2 are taken, and that ``print`` finds a stream.

    Else files of ours would have them: what a library prints, as libzmq does before it aborts,
    would go into a socket or a lock, and a zygote would have them as its own streams.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) < _NUMBERS:  # the lowest that is free
        os.set_inheritable(null, True)
    os.close(null)
    sys.stdin = sys.stdin or open(os.devnull)  # noqa: SIM115
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115

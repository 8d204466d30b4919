"""``envhub check REF`` as one of a list: it ends when the process that started it does.

``python -I -m envhub_sandbox.cli.check.child PID check ...``: no Ctrl-C of a terminal reaches it,
and whoever kills its parent by force leaves nobody who would end it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the command line; never returns."""
    parent = int(sys.argv.pop(1))
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(143)  # it has ended already
    from envhub_sandbox.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()

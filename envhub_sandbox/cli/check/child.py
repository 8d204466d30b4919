"""``envhub check REF`` as one of a list: it ends when the process that started it does.

``python -I -m envhub_sandbox.cli.check.child PIDFD check ...``: no Ctrl-C of a terminal reaches it,
and where its parent is killed by force, nothing else would end it.
"""

from __future__ import annotations

import sys

from envhub_sandbox.check.many.judgements import PATIENCE_S
from envhub_sandbox.system.platform import end_with


def main() -> None:
    """Run the command line; never returns."""
    end_with(int(sys.argv.pop(1)), PATIENCE_S)
    from envhub_sandbox.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()

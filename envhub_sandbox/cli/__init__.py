"""The command line ``envhub``: one file per command. Importing this imports nothing heavy."""

from __future__ import annotations


def main() -> None:
    """Run the command line; never returns."""
    import signal
    import sys

    from envhub_sandbox.cli.app import app
    from envhub_sandbox.cli.exits import Exit

    # so that a terminated run closes its environments and restores the terminal
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(Exit.TERMINATED))
    app(prog_name="envhub")

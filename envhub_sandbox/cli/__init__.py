"""The command line ``envhub``: one file per command. Importing this imports nothing heavy."""

from __future__ import annotations


def main() -> None:
    """Run the command line; never returns."""
    import io
    import signal
    import sys

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that knows ASCII only is no error
            stream.reconfigure(errors="backslashreplace")
    # so that a terminated run closes its environments and restores the terminal
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        from envhub_sandbox.cli.app import app

        app(prog_name="envhub")
    except KeyboardInterrupt:  # while still importing; later, commands report it themselves
        sys.exit(130)

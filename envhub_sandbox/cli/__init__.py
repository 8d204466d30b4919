"""The command line ``envhub``, a file or a folder for each command. This imports nothing heavy."""

from __future__ import annotations


def main() -> None:
    """Run the command line; never returns."""
    import io
    import os
    import signal
    import sys

    from envhub_sandbox.system.platform import replace_missing_streams

    replace_missing_streams()
    # its bars would get into ours, and into the stderr of scripts
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
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

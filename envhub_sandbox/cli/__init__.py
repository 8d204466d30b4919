"""The command line ``envhub``: a file for each command, imported when the command is called."""

from __future__ import annotations


def main() -> None:
    """Run the command line; never returns."""
    import io
    import os
    import signal
    import sys

    from envhub_sandbox.system.platform import replace_missing_streams

    replace_missing_streams()
    # huggingface_hub's progress bars would mix with ours, and with the stderr of scripts
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # for terminals that show only ASCII
            stream.reconfigure(errors="backslashreplace")
    # so that a terminated run closes its environments and restores the terminal
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        from envhub_sandbox.cli.app import app

        app(prog_name="envhub")
    except KeyboardInterrupt:  # during the imports; later, commands report it themselves
        sys.exit(130)

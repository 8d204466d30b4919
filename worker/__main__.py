"""The worker's program. Its contract:

``envhub-worker serve --endpoint E --runtime-dir D [--readable-root P ...] [--ready-fd N]
[--client-pidfd N]``

- argv: ``E`` is the ZeroMQ endpoint to bind, ``ipc://`` in a folder of mode 0700. ``D`` is an
  existing private folder for what lives as long as the server; it is removed at the end. ``P``
  are the folders that snapshots may lie in; nothing else of the machine's data is shown to a
  jail.
- file descriptors: ``--ready-fd`` gets one line (``ready``) once the endpoint is bound, and is
  closed. ``--client-pidfd`` is a pidfd of the client: when that process ends, so does all of this.
  stdin is not read; stdout and stderr are for people.
- environment: nothing is read from it but what Python itself needs.
- exit code: 0 after a stop, 2 for wrong arguments.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path


def main(argv: Sequence[str] | None = None) -> int:
    """Run a worker server until it is told to stop or its client ends."""
    arguments = _parser().parse_args(argv)
    from envhub_worker.server import Server

    server = Server(
        arguments.endpoint,
        arguments.runtime_dir,
        arguments.readable_root,
        arguments.client_pidfd,
    )
    server.stop_on(signal.SIGTERM, signal.SIGINT)
    if arguments.ready_fd is not None:
        os.write(arguments.ready_fd, b"ready\n")
        os.close(arguments.ready_fd)
    server.run()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="envhub-worker", description="Executes environments from the Hub under confinement."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    serve = commands.add_parser("serve", help="serve one client on an ipc:// endpoint")
    serve.add_argument("--endpoint", required=True)
    serve.add_argument("--runtime-dir", type=Path, required=True)
    serve.add_argument("--readable-root", action="append", default=[])
    serve.add_argument("--ready-fd", type=int)
    serve.add_argument("--client-pidfd", type=int)
    return parser


if __name__ == "__main__":
    sys.exit(main())

"""``envhub-worker drain``: end the ``listen`` of this state folder gently, and wait until it has.

It sends SIGTERM. The server's option ``--drain-s`` says how long open jails go on.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
from pathlib import Path

from envhub_worker.extras.access.audit.figures import pid_namespace
from envhub_worker.extras.access.commands import status
from envhub_worker.protocol.errors import ProtocolError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``drain``."""
    parser.add_argument("--state-dir", type=Path, help="the server's state folder")
    parser.add_argument("--no-wait", action="store_true", help="return before the server has ended")


def run(arguments: argparse.Namespace) -> int:
    """End the server of a state folder: it accepts no new jails and waits for open ones."""
    try:
        pidfd, drains = _server(arguments.state_dir)
    except (OSError, ValueError, ProtocolError, status.UnreachableError) as error:
        sys.stderr.write(f"envhub-worker drain: {error}\n")
        return 1
    if not drains:  # a second one would end it at once
        signal.pidfd_send_signal(pidfd, signal.SIGTERM)
    if not arguments.no_wait:
        select.select([pidfd], [], [])
    os.close(pidfd)
    return 0


def _server(chosen: Path | None) -> tuple[int, bool]:
    """Returns a pidfd of the server, and whether it drains. The server's key proves its answers."""
    address = status.address_here(chosen)
    if address[1] is None:
        raise status.UnreachableError(
            "a server without keys cannot prove that it is ours: send it SIGTERM yourself"
        )
    facts = status.of_server(*address)
    if not facts["pid_namespace"] or facts["pid_namespace"] != pid_namespace():
        raise status.UnreachableError(
            "the server runs in a container, where process ids are different: stop the container, "
            "or run this command in it"
        )
    pidfd = os.pidfd_open(facts["pid"])
    try:
        # The pid may have been reused before we opened it. If the server names the same pid again,
        # it has had it all the time.
        if status.of_server(*address)["pid"] != facts["pid"]:
            raise status.UnreachableError("the server has just been replaced: try again")
    except BaseException:
        os.close(pidfd)
        raise
    return pidfd, facts["draining_s"] is not None

"""``envhub-worker health``: whether a server answers, which a container's health check asks."""

from __future__ import annotations

import argparse
import socket
from pathlib import Path

from envhub_worker.extras.access.commands.status import status_is_healthy

# The greeting of ZMTP 3: both sides send it before any key (https://rfc.zeromq.org/spec/23).
_GREETING = b"\xff"
_WAIT_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``health``."""
    parser.add_argument(
        "--port", type=int, default=5555, help="the server's port on 127.0.0.1 (default: 5555)"
    )
    parser.add_argument("--state-dir", type=Path, help="the server's state folder")


def run(arguments: argparse.Namespace) -> int:
    """Exit with 0 if the server on this machine answers, and with 1 if it does not."""
    healthy = status_is_healthy(arguments.state_dir)
    return 0 if healthy or (healthy is None and answers("127.0.0.1", arguments.port)) else 1


def answers(host: str, port: int) -> bool:
    """Whether a ZeroMQ peer at the address sends its greeting."""
    try:
        with socket.create_connection((host, port), _WAIT_S) as connection:
            greeting = connection.recv(1)
    except OSError:
        return False
    return greeting == _GREETING

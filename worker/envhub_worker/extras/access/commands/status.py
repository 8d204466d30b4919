"""``envhub-worker status``: ask a running ``listen``, as its operator."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, TypeVar

import zmq

from envhub_worker.extras.access import keys
from envhub_worker.extras.access.commands.identity import reachable
from envhub_worker.extras.access.commands.state_folder import read_note, state_dir
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.keys import parse_key
from envhub_worker.protocol.text import counted, printable, size_text
from envhub_worker.server.sessions import WATCHER

_WAIT_MS = 5_000
_Reply = TypeVar("_Reply", bound=m.Message)


class UnreachableError(Exception):
    """No server runs, or it does not answer us."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``status``."""
    parser.add_argument("--state-dir", type=Path, help="the server's state folder")
    parser.add_argument("--endpoint", help="of a server on another host: tcp://HOST:PORT")
    parser.add_argument("--server-key", help="that server's public key")
    parser.add_argument("--key", type=Path, help="file with the secret key of a client on its list")
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def run(arguments: argparse.Namespace) -> int:
    """Print sessions, connections and jails of a server, and its state."""
    try:
        sessions, server = _ask(*_address(arguments))
    except (OSError, ValueError, ProtocolError, UnreachableError) as error:
        sys.stderr.write(f"envhub-worker status: {error}\n")
        return 1
    if arguments.json:
        print(json.dumps({"server": server, "sessions": sessions}, indent=2))
    else:
        print(f"{head(server)}\n{table(sessions)}")
    return 0


def _address(arguments: argparse.Namespace) -> tuple[str, bytes | None, keys.KeyPair]:
    """Returns the endpoint, the server's public key, and our own key pair."""
    if arguments.endpoint:
        if not arguments.server_key or not arguments.key:
            raise ValueError("--endpoint needs --server-key and --key")
        return arguments.endpoint, parse_key(arguments.server_key), keys.load(arguments.key)
    return address_here(arguments.state_dir)


def address_here(chosen: Path | None) -> tuple[str, bytes | None, keys.KeyPair]:
    """Returns the address of the server on a state folder here. Raises ``UnreachableError``."""
    noted = _noted(chosen)
    if noted is None:
        folder = state_dir(chosen, create=False)
        at = f" with the state folder {folder}; --state-dir names another" if folder else ""
        raise UnreachableError(f"no 'envhub-worker listen' of this user is running here{at}")
    return noted


def _noted(chosen: Path | None) -> tuple[str, bytes | None, keys.KeyPair] | None:
    """Reads the note of this user's server; None if there is none."""
    state = state_dir(chosen, create=False)
    noted = None if state is None else read_note(state)
    if noted is None:
        return None
    if noted.public == "insecure":
        return noted.endpoint, None, keys.generate()
    return reachable(noted.endpoint), parse_key(noted.public), keys.load(Path(noted.key_file))


def status_is_healthy(chosen: Path | None) -> bool | None:
    """Whether this user's server answers requests; None if there is none here."""
    try:
        noted = _noted(chosen)
        if noted is not None:
            _ask(*noted)
    except (OSError, ValueError, ProtocolError, UnreachableError):
        return False
    return None if noted is None else True


def _ask(
    endpoint: str, server_key: bytes | None, pair: keys.KeyPair
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Asks a server; returns its sessions and the facts about itself."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.IPV6, "[" in endpoint)
        if server_key is not None:
            socket.setsockopt(zmq.CURVE_SERVERKEY, server_key)
            socket.setsockopt(zmq.CURVE_PUBLICKEY, pair.public)
            socket.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
        socket.connect(endpoint)
        _request(socket, m.Hello(m.VERSION, WATCHER), 1, m.Welcome)
        reply = _request(socket, m.GetSessions(), 2, m.Sessions)
    sessions = [dict(session) for session in reply.sessions if isinstance(session, dict)]
    return sessions, reply.server


def of_server(endpoint: str, server_key: bytes | None, pair: keys.KeyPair) -> dict[str, Any]:
    """Returns a server's facts for its operator. Raises ``UnreachableError``."""
    server = _ask(endpoint, server_key, pair)[1]
    if "pid_namespace" not in server:
        raise UnreachableError("the server does not know this key as its operator's")
    return server


def _request(
    socket: zmq.Socket[bytes], request: m.Message, number: int, kind: type[_Reply]
) -> _Reply:
    socket.send_multipart(m.pack_header(request, number))
    if not socket.poll(_WAIT_MS):
        raise UnreachableError("the server does not answer: is the key one that it knows?")
    _, reply = m.unpack_header(socket.recv_multipart()[0])
    if isinstance(reply, m.Refusal):
        raise UnreachableError(printable(reply.message))
    if not isinstance(reply, kind):
        raise UnreachableError(f"the server answered with {type(reply).__name__}")
    return reply


def head(server: dict[str, Any]) -> str:
    """Returns a line or two about the server itself."""
    lines = [
        f"envhub-worker {server['version']}, protocol {server['protocol']}, profile "
        f"{server['profile']} at most"
    ]
    if "disk" in server:
        free = size_text(server["disk"]["free_bytes"])
        connections = counted(server["connections"], "connection")
        lines[0] += f", {connections}, {free} of disk free"
        refusals, deaths = sum(server["refusals"].values()), sum(server["deaths"].values())
        counts = f"{counted(refusals, 'refusal')}, {counted(deaths, 'death')}"
        lines.append(f"since its start: {counts}")
    if server["draining_s"] is not None:
        lines.append(f"draining: open jails have {server['draining_s']:.0f} s left")
    return printable("\n".join(lines))


def table(sessions: list[dict[str, Any]]) -> str:
    """Returns the sessions and their jails, one line each."""
    lines = [counted(len(sessions), "session")]
    for session in sessions:
        lines.append(
            f"{session['client']} {session['session']}: heard {session['heard_s']:.0f} s ago, "
            f"{counted(session['connections'], 'connection')}, "
            f"{size_text(session['upload_bytes'])} of snapshots, "
            f"{counted(len(session['jails']), 'jail')}"
        )
        for jail in session["jails"]:
            doing = f"{jail['operation']} for {jail['busy_s']:.1f} s" if jail["operation"] else "-"
            lines.append(f"  {jail['name']}: {', '.join(jail['states'])}; {doing}")
    # line by line: a name is a client's, and neither ends its line nor crowds out another's
    return "\n".join(printable(line).replace("\n", "\\n") for line in lines)

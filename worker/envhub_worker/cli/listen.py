"""``envhub-worker listen``: a worker server for clients on other hosts.

It never listens without keys but on a loopback address and when told so, nor on all interfaces
unless told so. Without ``--authorized-clients`` it makes a key for one client and prints it:
nobody else comes in.
"""

from __future__ import annotations

import argparse
import contextlib
import ipaddress
import os
import resource
import signal
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import zmq

from envhub_worker import __version__
from envhub_worker.access import keys
from envhub_worker.access.audit.log import FORMS, LEVELS, Log
from envhub_worker.access.keys import AuthorizedClients, KeyPair
from envhub_worker.access.packages import MAKE_S, Packages, why_impossible
from envhub_worker.access.port.connection_limit import MAX_CONNECTIONS
from envhub_worker.access.quotas import Permissions, Quotas
from envhub_worker.access.remote_gate import RemoteGate, Rules
from envhub_worker.access.store.uploads import Uploads
from envhub_worker.cli.note import Note, Noted
from envhub_worker.lockdown import probe, surroundings
from envhub_worker.lockdown.mechanisms import landlock, locked_folder
from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder
from envhub_worker.protocol.confinement import PROFILES
from envhub_worker.protocol.keys import key_text
from envhub_worker.protocol.text import parse_size, size_text
from envhub_worker.server import Server

DEFAULT_BIND = "tcp://127.0.0.1:5555"
_IDLE_S = 120
_MAX_OPEN_FILES = 65_536
_ANY_HOST = frozenset({"0.0.0.0", "*", "[::]"})
_CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv")


Publish = Callable[[Mapping[str, Any]], None]


class UsageError(Exception):
    """The arguments ask for what must not be, or cannot."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``listen``."""
    parser.add_argument(
        "--max-connections",
        type=_count,
        default=MAX_CONNECTIONS,
        help=f"of everybody together, strangers included (default: {MAX_CONNECTIONS})",
    )
    parser.add_argument(
        "--bind",
        default=DEFAULT_BIND,
        metavar="tcp://HOST:PORT",
        help=f"where to listen (default: {DEFAULT_BIND})",
    )
    parser.add_argument("--key", type=Path, help="the server's secret key (see keygen)")
    parser.add_argument(
        "--authorized-clients",
        type=Path,
        metavar="FILE",
        help="clients' public keys, one a line; without it one is made and printed",
    )
    parser.add_argument("--insecure-loopback", action="store_true", help="no keys; loopback only")
    parser.add_argument("--state-dir", type=Path, help="keys and snapshots; private, writable")
    parser.add_argument(
        "--idle-s",
        type=_seconds,
        default=_IDLE_S,
        help=f"end jails of clients that are silent for so long; 0: never (default: {_IDLE_S})",
    )
    parser.add_argument(
        "--metrics",
        metavar="[ADDRESS:]PORT",
        help="answer GET /metrics, /healthz and /readyz there, over plain HTTP and without keys; "
        "on 127.0.0.1, unless another address is given",
    )
    parser.add_argument(
        "--drain-s",
        type=_seconds,
        default=0,
        help="after SIGTERM let nothing new in, and give open jails so long; a second SIGTERM ends "
        "at once (default: 0, the first one does)",
    )
    parser.add_argument(
        "--weakest-profile",
        choices=PROFILES,
        default=_weakest_profile(),
        help="that a policy may ask for (default here: %(default)s)",
    )
    parser.add_argument("--allow-network", action="store_true", help="permit network='host'")
    parser.add_argument("--allow-gpu", action="store_true", help="permit gpu=True")
    parser.add_argument(
        "--dependencies",
        action="store_true",
        help="install the packages that repositories declare; needs envhub-sandbox beside this",
    )
    parser.add_argument(
        "--packages-s",
        type=_count,
        default=int(MAKE_S),
        metavar="SECONDS",
        help=f"for so long an order of them may be at work (default: {MAKE_S:.0f})",
    )
    parser.add_argument(
        "--log-format",
        choices=tuple(FORMS),
        default="text",
        help="of the log, which goes to stderr, a line an event (default: text)",
    )
    parser.add_argument(
        "--log-level",
        choices=LEVELS,
        default="info",
        help="what is less important is left out (default: info)",
    )
    _add_quotas(parser)


def _add_quotas(parser: argparse.ArgumentParser) -> None:
    quotas = Quotas()
    for names, what, default in (
        (("--max-jails",), "open jails", quotas.jails),
        (("--max-runners", "--max-hosts"), "processes of environments", quotas.runners),
        (("--max-sessions",), "client processes", quotas.sessions),
        (("--max-upload-files",), "files of a snapshot", quotas.upload_files),
    ):
        parser.add_argument(
            *names, type=_count, default=default, help=f"of one key: {what} (default: {default})"
        )
    for name, what, size, unit in (
        ("--max-memory", "memory limits of jails", quotas.memory_bytes, "GiB"),
        ("--max-upload", "snapshots", quotas.upload_bytes, "MiB"),
        ("--max-packages", "installed packages", quotas.packages_bytes, "MiB"),
        ("--max-inflight", "unanswered requests", quotas.inflight_bytes, "MiB"),
    ):
        parser.add_argument(
            name,
            type=partial(_size, unit),
            default=size,
            metavar="SIZE",
            help=f"of one key: {what}, as in 16G; in {unit} without a unit (default: "
            f"{size_text(size)})",
        )


def _count(text: str) -> int:
    return _at_least(1, text)


def _size(unit: str, text: str) -> int:
    try:
        size = parse_size(text, unit[0].lower())
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}, and {text!r} is none") from None
    if size < 1:
        raise argparse.ArgumentTypeError(f"takes a size above 0, not {text!r}")
    return size


def _seconds(text: str) -> int:
    return _at_least(0, text)


def _at_least(least: int, text: str) -> int:
    with contextlib.suppress(ValueError):
        if int(text) >= least:
            return int(text)
    raise argparse.ArgumentTypeError(f"takes a whole number, {least} or more, not {text!r}")


def _weakest_profile() -> str:
    """In a container the container is the outer layer, and the others are often not to be had.

    But a jail of that profile is our user: without Landlock it would read our keys and all stores.
    """
    contained = any(map(os.path.exists, _CONTAINER_MARKS)) and landlock.version() >= 1
    return "container" if contained else "strict"


def run(arguments: argparse.Namespace) -> int:
    """Listen until told to stop."""
    try:
        with _state(arguments.state_dir) as state:
            return _listen(arguments, state)
    except (OSError, UsageError, ValueError) as error:
        sys.stderr.write(f"envhub-worker listen: {error}\n")
        return 2


def _listen(arguments: argparse.Namespace, state: Path) -> int:
    check_bind(arguments.bind, arguments.insecure_loopback)
    if arguments.dependencies and (why := why_impossible()):
        raise UsageError(f"--dependencies: {why}")
    strongest = surroundings.profiles(probe.probe()["layers"], landlock.version())
    identity = replace(_identity(arguments, state), profile=(*strongest, "strict")[0])
    log = Log(form=FORMS[arguments.log_format], level=arguments.log_level)
    why = unusable(identity.profile, arguments.weakest_profile)
    if why:
        log.say("no_jail_possible", "error", why=why)
    _raise_file_limit()
    with _watched(arguments.metrics, log, usable=not why) as publish:
        return _serve(arguments, state, identity, log, publish)


def _serve(
    arguments: argparse.Namespace,
    state: Path,
    identity: Identity,
    log: Log,
    publish: Publish | None,
) -> int:
    place = locked_folder.place_for_sockets()
    locked_folder.remove_deserted(place)
    runtime = LockedFolder("envhub-", place)
    try:
        gate = _gate(arguments, state, identity, log, publish)
        store = state / "store"
        server = Server(arguments.bind, runtime.path, [str(store)], gate=gate)
        key_file = (arguments.key or state / "server.key").absolute()
        note = Note(state, Noted(server.endpoint, identity.public, str(key_file)))
    except zmq.ZMQError as error:
        runtime.remove()
        raise UsageError(f"--bind {arguments.bind}: {error.strerror}") from None
    except BaseException:
        runtime.remove()
        raise
    server.stop_on(*_ends(), gently=(signal.SIGTERM,))
    began = time.monotonic()
    try:
        if arguments.log_format == "text" or identity.authorized is None:  # a client needs it
            print(announcement(server.endpoint, identity), flush=True)
        _log_start(log, server.endpoint, identity, arguments.weakest_profile)
        server.run()
    except Exception as error:  # not what it was told to do: see ``run`` for what is
        gate.witness.failed(error)
        return 1
    finally:
        log.say("stopped", "info", seconds=time.monotonic() - began)
        note.remove()
        runtime.remove()
    return 0


def _ends() -> list[signal.Signals]:
    """What ends the server at once; under ``nohup`` the end of a terminal does not."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGINT] if ignored else [signal.SIGINT, signal.SIGHUP]


def _log_start(log: Log, endpoint: str, identity: Identity, weakest: str) -> None:
    told = {"version": __version__, "endpoint": endpoint, "server_key": identity.public}
    profiles = {"strongest_profile": identity.profile, "weakest_profile": weakest}
    log.say("listening", "info", **told, **profiles, pid=os.getpid())


@contextmanager
def _watched(metrics: str | None, log: Log, *, usable: bool) -> Iterator[Publish | None]:
    """The port for whoever watches, if one is wanted: gives what is to be called with figures.

    Raises:
        UsageError: It cannot be had; the text says why.
    """
    if metrics is None:
        yield None
        return
    from envhub_worker.cli.http_port import HttpPort, parse_address
    from envhub_worker.cli.metrics import Page, exposition

    host, number = parse_address(metrics)
    try:
        page = Page(usable, exposition())
    except ImportError as error:
        raise UsageError(str(error)) from None

    def failed(why: str) -> None:
        log.say("metrics_failed", "error", traceback=why)

    try:
        port = HttpPort(host, number, page.answer, failed)
    except OSError as error:
        raise UsageError(f"--metrics {metrics}: {error}") from None
    if not _is_loopback(host):
        log.say("metrics_are_open", why="whoever reaches them reads the clients' names: no keys")
    log.say("metrics", "info", url=f"http://{port.address}/metrics")
    try:
        yield page.publish
    finally:
        port.close()


def _raise_file_limit() -> None:
    """Connections of strangers shall not take the descriptors that jails need."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MAX_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _MAX_OPEN_FILES)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def most_connections(wanted: int) -> int:
    """Half of our descriptors at most: the other half is for jails."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if soft == resource.RLIM_INFINITY else max(1, min(wanted, soft // 2))


# --- where it listens ------------------------------------------------------------------------


def check_bind(endpoint: str, insecure: bool) -> None:
    """Refuse what is no TCP address, and a loopback that is none.

    Raises:
        UsageError: With what to do instead.
    """
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    a_port = port == "*" or (port.isdigit() and int(port) <= 65_535)
    if not endpoint.startswith("tcp://") or not host or not a_port:
        raise UsageError(f"--bind takes tcp://HOST:PORT, not {endpoint!r}")
    if insecure and not _is_loopback(host):
        raise UsageError(
            f"--insecure-loopback needs a loopback address such as 127.0.0.1, and {host!r} is "
            "none: without keys anybody who reaches it could run code here"
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


# --- keys --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Identity:
    """Who the server is, and who may come in.

    Attributes:
        keys: The server's pair; None only behind ``--insecure-loopback``.
        client: The one client that was made, if there is no such file.
        fresh: Whether that was made just now.
        profile: The strongest profile that jails can have here.
    """

    keys: KeyPair | None
    authorized: Path | None = None
    client: KeyPair | None = None
    client_file: Path | None = None
    fresh: bool = False
    profile: str = "strict"

    @property
    def public(self) -> str:
        """The server's public key as text, or ``insecure``."""
        return "insecure" if self.keys is None else key_text(self.keys.public)


def _identity(arguments: argparse.Namespace, state: Path) -> Identity:
    if arguments.insecure_loopback:
        if arguments.key or arguments.authorized_clients:
            raise UsageError("--insecure-loopback has no keys: leave --key and others out")
        return Identity(None)
    if arguments.key:
        pair = keys.load(arguments.key)
    else:
        pair, _ = _kept_pair(state, "server")
    if arguments.authorized_clients:
        return Identity(pair, arguments.authorized_clients)
    client, fresh = _kept_pair(state, "client")
    return Identity(pair, None, client, state / "client.key", fresh)


def _kept_pair(state: Path, name: str) -> tuple[KeyPair, bool]:
    """The pair in the state folder, and whether it was made just now."""
    with contextlib.suppress(FileNotFoundError):
        return keys.load(state / f"{name}.key"), False
    pair = keys.generate()
    (state / f"{name}.pub").unlink(missing_ok=True)
    keys.save(pair, state, name)
    return pair, True


def announcement(endpoint: str, identity: Identity) -> str:
    """What is printed at the start: the endpoint, the public key, and what a client writes."""
    lines = [f"envhub-worker {__version__} listens on {endpoint}"]
    reached = reachable(endpoint)
    policy = "" if identity.profile == "strict" else f", policy={{'profile': {identity.profile!r}}}"
    if policy:
        lines.append(f"jails here can have the profile {identity.profile!r} at most")
    if reached != endpoint:
        lines.append(f"(on all interfaces; from another host write its name for {reached!r})")
    if identity.keys is None:
        lines += ["No keys: every user of this machine can run code here.", ""]
        client = f"RemoteSandbox({reached!r}, insecure_loopback=True){policy}"
        return "\n".join([*lines, f"sandbox=envhub_sandbox.{client}"])
    lines.append(f"server's public key: {identity.public}")
    lines.append("")
    if identity.client is None:
        lines.append(f"Clients: those in {identity.authorized}. A client writes:")
        secret = "<its secret key, or the file that holds it>"
    elif identity.fresh:
        lines.append(f"No --authorized-clients: one client key was made ({identity.client_file}).")
        lines.append("Whoever has it can run code here, confined. The client writes:")
        secret = key_text(identity.client.secret)
    else:
        lines.append("No --authorized-clients: one client key, made earlier. The client writes:")
        secret = f"<what {identity.client_file} holds>"
    lines.append(
        f'  sandbox=envhub_sandbox.RemoteSandbox("{reached}", server_key="{identity.public}", '
        f'client_key="{secret}"){policy}'
    )
    lines.append(f'or, in its environment, and then sandbox="{reached}"{policy}:')
    lines.append(f"  ENVHUB_SERVER_KEY={identity.public} ENVHUB_CLIENT_KEY={secret!r}")
    return "\n".join(lines)


def unusable(strongest: str, weakest: str) -> str:
    """A warning, or nothing: where no jail can have what is permitted at least."""
    if PROFILES.index(strongest) <= PROFILES.index(weakest):
        return ""
    return (
        f"no jail can be opened here: the strongest profile to be had is {strongest!r}, and "
        f"--weakest-profile permits nothing weaker than {weakest!r}"
    )


def reachable(endpoint: str) -> str:
    """An endpoint that a client on this machine can connect to."""
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    return f"tcp://127.0.0.1:{port}" if host in _ANY_HOST else endpoint


def _gate(
    arguments: argparse.Namespace,
    state: Path,
    identity: Identity,
    log: Log,
    publish: Publish | None = None,
) -> RemoteGate:
    known = {} if identity.client is None else {identity.client.public: "the one client"}
    pair = identity.keys
    operators = frozenset[bytes]() if pair is None else frozenset({pair.public})
    quotas = Quotas(
        jails=arguments.max_jails,
        runners=arguments.max_runners,
        memory_bytes=arguments.max_memory,
        upload_bytes=arguments.max_upload,
        upload_files=arguments.max_upload_files,
        packages_bytes=arguments.max_packages,
        inflight_bytes=arguments.max_inflight,
        sessions=arguments.max_sessions,
    )
    rules = Rules(
        keys=identity.keys,
        authorized=AuthorizedClients(identity.authorized, known, _most_clients(arguments)),
        operators=operators,
        quotas=quotas,
        permissions=Permissions(
            weakest_profile=arguments.weakest_profile,
            network=arguments.allow_network,
            gpu=arguments.allow_gpu,
            dependencies=arguments.dependencies,
        ),
        idle_s=arguments.idle_s,
        max_connections=most_connections(arguments.max_connections),
        drain_s=arguments.drain_s,
        profile=identity.profile,
    )
    folder = state / "packages" if arguments.dependencies else None
    packages = Packages(folder, quotas, arguments.packages_s)
    return RemoteGate(rules, Uploads(state / "store", quotas), packages, log, publish)


def _most_clients(arguments: argparse.Namespace) -> int | None:
    """One, where nothing keeps a jail from the other clients' files."""
    shared = arguments.weakest_profile == "container" and landlock.version() < 1
    return 1 if shared else None


# --- the state folder --------------------------------------------------------------------------


@contextmanager
def _state(chosen: Path | None) -> Iterator[Path]:
    """The state folder; one that nobody can find again is removed."""
    folder = state_dir(chosen, create=True)
    if folder is not None:
        yield folder
        return
    made = LockedFolder("envhub-state-")
    try:
        yield made.path
    finally:
        made.remove()


def state_dir(chosen: Path | None, *, create: bool) -> Path | None:
    """Where keys and snapshots lie: the same for ``listen``, ``health`` and ``status``.

    ``chosen``, or ``envhub-worker`` in the user's state folder, or a folder of the temporary one
    where that cannot be written (a read-only container); None if not even that can be had.

    Raises:
        OSError: ``chosen`` cannot be had.
    """
    if chosen is not None:
        if create:
            _make_private(chosen)
        return chosen.absolute()  # jails are made elsewhere, and are told where snapshots lie
    home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    temporary = Path(tempfile.gettempdir()) / f"envhub-worker-{os.getuid()}"
    for candidate in (Path(home) / "envhub-worker", temporary):
        with contextlib.suppress(OSError):
            if create:
                _make_private(candidate)
            if _is_ours(candidate):
                return candidate
    return None


def _make_private(folder: Path) -> None:
    # Root's jails run as another user, who must get through to the snapshots, and no further.
    folder.mkdir(mode=0o711 if os.getuid() == 0 else 0o700, parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written")
    found = folder.stat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(
            f"the state folder {folder} holds keys, and others can change what is in it: it "
            f"belongs to uid {found.st_uid} and has mode {stat.S_IMODE(found.st_mode):04o}. Give "
            f"it to uid {os.getuid()} and chmod go-w it, or let --state-dir name a new one"
        )


def _is_ours(folder: Path) -> bool:
    """Whether nobody else could have put it there: the temporary folder is everybody's.

    One that we own and cannot write is a read-only container's, and no server's.
    """
    found = folder.lstat()
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    return ours and not found.st_mode & 0o022 and os.access(folder, os.W_OK)

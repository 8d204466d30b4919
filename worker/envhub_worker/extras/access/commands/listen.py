"""``envhub-worker listen``: a worker server for clients on other hosts.

It listens without keys only with --insecure-loopback on a loopback address, and on all interfaces
only if --bind names them. Without ``--authorized-clients`` it makes a key for one client and prints
it; no other client may connect.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import zmq

from envhub_worker import __version__
from envhub_worker.extras import surroundings
from envhub_worker.extras.access.audit.log import FORMS, Log
from envhub_worker.extras.access.commands.identity import (
    Identity,
    UsageError,
    announcement,
    check_bind,
    identity_of,
    is_loopback,
    unusable,
)
from envhub_worker.extras.access.commands.listen_options import add_options, quotas_of
from envhub_worker.extras.access.commands.state_folder import Note, ServerNote, state_folder
from envhub_worker.extras.access.keys import AuthorizedClients
from envhub_worker.extras.access.packages import Packages, why_impossible
from envhub_worker.extras.access.quotas import Permissions, Rules
from envhub_worker.extras.access.remote_gate import RemoteGate
from envhub_worker.extras.access.store.uploads import Uploads
from envhub_worker.lockdown import probe
from envhub_worker.lockdown.mechanisms import landlock, locked_folder
from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder
from envhub_worker.lockdown.mechanisms.process import raise_file_limit
from envhub_worker.protocol.confinement import Surroundings
from envhub_worker.server.server import Server

add_arguments = add_options

Publish = Callable[[Mapping[str, Any]], None]


def run(arguments: argparse.Namespace) -> int:
    """Listen until a signal ends it."""
    try:
        with state_folder(arguments.state_dir) as state:
            return _listen(arguments, state)
    except (OSError, UsageError, ValueError) as error:
        sys.stderr.write(f"envhub-worker listen: {error}\n")
        return 2


def _listen(arguments: argparse.Namespace, state: Path) -> int:
    check_bind(arguments.bind, arguments.insecure_loopback)
    around = surroundings.measure() if arguments.announce else None
    if arguments.dependencies and (why := why_impossible()):
        raise UsageError(f"--dependencies: {why}")
    strongest = surroundings.profiles(probe.probe()["layers"], landlock.version())
    identity = replace(identity_of(arguments, state), profile=(*strongest, "strict")[0])
    log = Log(form=FORMS[arguments.log_format], level=arguments.log_level)
    why = unusable(identity.profile, arguments.weakest_profile)
    if why:
        log.say("no_jail_possible", "error", why=why)
    raise_file_limit()  # connections of strangers shall not take the descriptors that jails need
    with _watched(arguments.metrics, log, usable=not why) as publish:
        return _serve(arguments, state, identity, log, publish, around)


def _serve(
    arguments: argparse.Namespace,
    state: Path,
    identity: Identity,
    log: Log,
    publish: Publish | None,
    around: Surroundings | None,
) -> int:
    parent = locked_folder.place_for_sockets()
    locked_folder.remove_deserted(parent)
    with contextlib.ExitStack() as ends:
        runtime = LockedFolder("envhub-", parent)
        ends.callback(runtime.remove)
        ended = arguments.client_pidfd  # readable once that process has ended
        if arguments.until_eof:
            ended = 0  # stdin is readable at its end
        try:
            gate = _gate(arguments, state, identity, log, publish)
            roots = [str(state / "store")]
            server = Server(arguments.bind, runtime.path, roots, ended, gate=gate)
        except zmq.ZMQError as error:
            raise UsageError(f"--bind {arguments.bind}: {error.strerror}") from None
        if not arguments.only_client:
            key_file = (arguments.key or state / "server.key").absolute()
            noted = ServerNote(server.endpoint, identity.public, str(key_file))
            ends.callback(Note(state, noted).remove)
        began = time.monotonic()
        ends.callback(lambda: log.say("stopped", "info", seconds=time.monotonic() - began))
        # nohup has SIGHUP ignored; then the end of the terminal does not end the server
        ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        hangs_up = [] if ignored else [signal.SIGHUP]
        server.stop_on(signal.SIGINT, *hangs_up, gently=(signal.SIGTERM,))
        try:
            _announce(arguments, identity, server.endpoint, around)
            log.say(
                "listening",
                "info",
                version=__version__,
                endpoint=server.endpoint,
                server_key=identity.public,
                strongest_profile=identity.profile,
                weakest_profile=arguments.weakest_profile,
                pid=os.getpid(),
            )
            server.run()
        except Exception as error:  # no error of the arguments: ``run`` reports those
            gate.witness.failed(error)
            return 1
    return 0


def _announce(
    arguments: argparse.Namespace, identity: Identity, endpoint: str, around: Surroundings | None
) -> None:
    """Announce the address in the form that the starting program reads."""
    if arguments.ready_fd is not None:
        with contextlib.suppress(BrokenPipeError):  # the starting program ended: the loop notices
            os.write(arguments.ready_fd, f"{endpoint} {identity.public}\n".encode())
        os.close(arguments.ready_fd)
    elif around is not None:
        print(surroundings.announcement(around, server_key=identity.public), flush=True)
    elif arguments.log_format == "text" or identity.authorized is None:  # a client needs the key
        print(announcement(endpoint, identity), flush=True)


@contextmanager
def _watched(metrics: str | None, log: Log, *, usable: bool) -> Iterator[Publish | None]:
    """Opens the port for monitoring, if there is one; yields the function that publishes figures.
    Raises ``UsageError``: the port cannot be opened.
    """
    if metrics is None:
        yield None
        return
    from envhub_worker.extras.access.commands.http_port import HttpPort, parse_address
    from envhub_worker.extras.access.commands.metrics import MetricsPage, exposition

    host, number = parse_address(metrics)
    try:
        page = MetricsPage(usable, exposition())
    except ImportError as error:
        raise UsageError(str(error)) from None

    def failed(why: str) -> None:
        log.say("metrics_failed", "error", traceback=why)

    try:
        port = HttpPort(host, number, page.answer, failed)
    except OSError as error:
        raise UsageError(f"--metrics {metrics}: {error}") from None
    if not is_loopback(host):
        log.say("metrics_are_open", why="who reaches them reads the clients' names: no keys")
    log.say("metrics", "info", url=f"http://{port.address}/metrics")
    try:
        yield page.publish
    finally:
        port.close()


def most_connections(wanted: int) -> int:
    """Returns the maximum of connections: half of our descriptors, the other half is for jails."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if soft == resource.RLIM_INFINITY else max(1, min(wanted, soft // 2))


def _gate(
    arguments: argparse.Namespace,
    state: Path,
    identity: Identity,
    log: Log,
    publish: Publish | None,
) -> RemoteGate:
    clients = {} if identity.client is None else {identity.client.public: "the one client"}
    quotas = quotas_of(arguments)
    # only one client, if nothing keeps a jail from the files of other clients
    single = arguments.weakest_profile == "container" and landlock.version() < 1
    rules = Rules(
        keys=identity.keys,
        authorized=AuthorizedClients(identity.authorized, clients, 1 if single else None),
        operators=frozenset({identity.keys.public} if identity.keys else ()),
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
    # such servers of one user share the folder; each has its own key, for the program it serves
    shared = bool(arguments.only_client) and arguments.client_pidfd is not None
    packages = Packages(folder, quotas, arguments.packages_s, shared=shared)
    uploads = Uploads(state / "store", quotas, shared=shared)
    return RemoteGate(rules, uploads, packages, log, publish)

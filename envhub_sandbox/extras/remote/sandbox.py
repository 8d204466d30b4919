"""``sandbox="tcp://host:5555"``: the worker on another host, over ZeroMQ with CURVE keys.

``envhub-worker listen`` runs there. The client uploads the repository's files, by content, so the
server needs neither the Hub nor a token. A thread of the client tells the server that the client
lives; the server closes the jails of a client that has gone.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

from envhub_sandbox.errors import EnvHubError, PolicyError
from envhub_sandbox.extras.remote import keys as remote_keys
from envhub_sandbox.extras.remote.repository import ServerPackages, UploadedRepository
from envhub_sandbox.extras.remote.tcp import TcpServer
from envhub_sandbox.sandboxes.pool import ServerPool, ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.platform import OwnerProcess
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import PROFILES
from envhub_worker.protocol.runtime import OWN, Runtime
from envhub_worker.protocol.text import printable

_KEEP_ALIVE_S = 10.0
_FIRST_S = 0.5
_STOP_S = 1.0
_CLOSE_S = 5.0


@dataclass
class RemoteSandbox(Sandbox):
    """Workers on another host.

    Attributes:
        endpoint: ``tcp://HOST:PORT`` of the server's ``envhub-worker listen``. ``tcp://HOST:PORT
            KEY`` includes the server's public key.
        server_key: The server's public key; by default ``$ENVHUB_SERVER_KEY``, or the server's line
            ``HOST:PORT KEY`` in ``known_hosts`` in the configuration folder.
        client_key: The client's secret key, or a file with it; by default ``$ENVHUB_CLIENT_KEY``
            (a key or a file, too), or ``client.key`` in the configuration folder.
        insecure_loopback: Use no keys, with a server on this machine that has no keys, either.
        heartbeat_s: After so many seconds without a heartbeat the connection counts as lost. Raise
            it if one batch of observations takes longer than this to transfer.
        retry_s: Seconds to wait in line while the server has no room for this key; 0, the
            default, raises ``ServerBusyError`` at once.
    """

    endpoint: str
    server_key: str | None = None
    client_key: str | os.PathLike[str] | None = field(default=None, repr=False)
    insecure_loopback: bool = False
    heartbeat_s: float = 30.0
    retry_s: float = 0.0
    name = "remote"
    _orders: dict[str, m.NeedPackages] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        self.endpoint, _, key = self.endpoint.partition(" ")
        self.server_key = key.strip() or self.server_key
        remote_keys.address_of(self.endpoint)
        if self.insecure_loopback and not remote_keys.is_loopback(self.endpoint):
            raise PolicyError(
                f"insecure_loopback=True is for a server on this machine, and {self.endpoint} is "
                "not on a loopback address: anybody on the way could read and change everything"
            )
        if self.insecure_loopback and self.server_key is not None:
            raise PolicyError(
                f"insecure_loopback=True is for a server without keys, and {self.endpoint} has "
                "server_key: leave one out"
            )
        if not self.heartbeat_s > 0:
            raise PolicyError(f"heartbeat_s is {self.heartbeat_s!r}; it takes seconds above 0")
        if not 0 <= self.retry_s < float("inf"):
            raise PolicyError(f"retry_s is {self.retry_s!r}; it takes seconds, 0 or more")

    @property
    def address(self) -> str:
        """Its endpoint."""
        return self.endpoint

    def __getstate__(self) -> dict[str, Any]:
        """Leave a secret key out of the pickle, but keep a file's name: the reader has its own."""
        kept = self.client_key if remote_keys.is_key_file(self.client_key) else None
        return {**self.__dict__, "client_key": kept, "_orders": {}}

    def __copy__(self) -> RemoteSandbox:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> RemoteSandbox:
        return replace(self)

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> RemoteRepository:
        """Return the sandbox for one repository. Connects to nothing.
        Raises ``PolicyError``: the policy names things of this machine; see ``check_policy``;
        ``SandboxUnavailableError``: a key is missing.
        """
        check_policy(policy, runtime)
        order = self._orders[runtime.packages] if runtime.packages else None
        given = snapshot, order, runtime.packages, self.endpoint, self.far()
        return RemoteRepository(*given, self.retry_s)

    def package_target(self) -> ServerPackages:
        """See ``Sandbox``: the server makes the packages itself."""
        return ServerPackages(lambda: _use_of(self.endpoint, self.far()), self._orders)

    def far(self) -> TcpServer:
        """Find the keys of both sides. Raises ``SandboxUnavailableError``: one is missing."""
        if self.insecure_loopback:
            return TcpServer(None, None, self.heartbeat_s)
        server_key = remote_keys.server_key(self.endpoint, self.server_key)
        return TcpServer(server_key, remote_keys.client_key(self.client_key), self.heartbeat_s)


def check_policy(policy: Policy, runtime: Runtime) -> None:
    """Reject packages, an interpreter and files of this machine; the server would, too.
    Raises ``PolicyError``: the text says what to do instead.
    """
    if os.sep in runtime.packages:
        raise PolicyError(
            "dependencies: an environment of this machine is for this machine; a remote server "
            "makes its own, where it was started with --dependencies"
        )
    if runtime.python:
        raise PolicyError(
            f"{option_name('python', runtime.python)} is an interpreter of this machine, and a "
            "remote server has its own: start the server in the environment or image that the "
            "repository needs"
        )
    if policy.readable:
        raise PolicyError(
            f"{option_name('readable', list(policy.readable))} are paths of this machine, and "
            "jails on a remote server have the repository's files only: put the files into the "
            "repository"
        )


# --- servers ---------------------------------------------------------------------------------


@dataclass(eq=False)
class RemoteRepository(UploadedRepository):
    """The sandbox of one repository on another host."""

    name = "remote"
    endpoint: str
    far: TcpServer
    retry_s: float = 0.0

    @property
    def address(self) -> str:
        """Its endpoint."""
        return self.endpoint

    def runs_on(self, runtime: Runtime) -> Runtime:
        """See ``Sandbox``: names the server, its key, and the packages there."""
        key = "" if self.far.server_key is None else self.far.server_key.hex()
        return Runtime(f"{self.endpoint} {key}{self.packages and f' {self.packages}'}")

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[RemoteServer]:
        """See ``Sandbox``: the server runs already; this sends nothing."""
        return _use_of(self.endpoint, self.far)


class RemoteServer(WorkerServer):
    """A server on another host that environments of this process use.
    ``process_fd``: becomes readable when this process stops using the server.
    """

    far: TcpServer
    is_ours = False

    def __init__(self, endpoint: str, far: TcpServer) -> None:
        self.endpoint = endpoint
        self.far = far
        self.uploading = threading.Lock()
        self._owner = OwnerProcess()
        self._ended = False
        # a pair of sockets, because ZeroMQ can poll no other descriptors on Windows
        self.process_fd, wakes = (end.detach() for end in socket.socketpair())
        self._wakes = [wakes]
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._keep_alive, name=f"envhub keep-alive {endpoint}", daemon=True
        )
        self._thread.start()

    def _keep_alive(self) -> None:
        """Tell the server which jails this living client holds; try again after any failure.

        Without these messages the server would close the jails of a living client.
        """
        client: WorkerConnection | None = None
        every_s = _FIRST_S
        while not self._stop.wait(every_s):
            with contextlib.suppress(RuntimeError):  # another thread has just connected
                for link in self.far.links:
                    link.read_ahead()
            try:
                if client is None:
                    client = self._connection()
                    client.hello(Deadline(_KEEP_ALIVE_S))
                    every_s = min(_KEEP_ALIVE_S, client.patience_s / 4 or _KEEP_ALIVE_S)
                client.request(m.KeepAlive(tuple(self.far.held)), deadline=Deadline(_KEEP_ALIVE_S))
            except Exception as error:  # of any kind: too few descriptors are a ZMQError
                WORKER.debug("%s has not heard that this client lives: %s", self.endpoint, error)
                _close(client)
                client = None
        _close(client)

    def _connection(self) -> WorkerConnection:
        return WorkerConnection(self.endpoint, self.process_fd, far=self.far)

    def _wake(self) -> None:
        """End every wait for an answer. Any thread may call this; idempotent."""
        with contextlib.suppress(IndexError):
            socket.close(self._wakes.pop())

    @property
    def runs(self) -> bool:
        """Always true, because only a request shows whether the server runs."""
        return True

    def stop(self) -> None:
        """See ``WorkerServer``: close the open jails, and end the keep-alive thread."""
        if self._ended or not self._owner.is_here:
            return
        # the jails that are still open there, when the process ends without closing them
        if self.far.held:
            client, deadline = self._connection(), Deadline(_CLOSE_S)
            with contextlib.suppress(EnvHubError), contextlib.closing(client):
                client.hello(deadline)
                for jail in tuple(self.far.held):
                    client.request(m.CloseJail(jail), deadline=deadline)
        self._stop.set()
        self._wake()
        self._thread.join(_STOP_S)
        if not self._thread.is_alive():
            self._ended = True  # close only once: another file may get this descriptor's number
            socket.close(self.process_fd)


def _close(client: WorkerConnection | None) -> None:
    """Close a connection in any state."""
    with contextlib.suppress(Exception):
        if client is not None:
            client.close()


SERVERS: ServerPool[RemoteServer] = ServerPool()
"""The servers that this process uses, one for each endpoint with its keys."""


def _use_of(endpoint: str, far: TcpServer) -> ServerUse[RemoteServer]:
    return SERVERS.acquire((endpoint, far), partial(RemoteServer, endpoint, far))


# --- a server's facts about itself, asked without using up the client's quota

_WAIT_S = 15.0
_LOOKER = b"status"
"""The session of a client that only asks for facts; the server does not count it."""
_WORDS = ("python", "profile", "weakest_profile")
_MOST = 1 << 63
_MOST_NAMES = 32
_MOST_CHARS = 64


@dataclass(frozen=True, kw_only=True)
class ServerFacts:
    """A server's facts about itself. Trust: input from the server; only types are checked.

    Attributes:
        protocol: The agreed version of the protocol.
        answered_s: Seconds from the start of the connection to the server's welcome.
        profile: The strongest profile of a jail there.
        weakest_profile: The weakest profile that a policy may ask for.
        network: Whether a policy may ask for the server's network.
        gpu: Whether a policy may ask for the server's GPUs.
        dependencies: Whether the server installs the packages that repositories declare.
        draining: Whether the server is about to end, and accepts nothing new.
        quotas: The quotas of this client's key.
        used: How much of them all processes with this key use together.
    """

    version: str
    protocol: int
    answered_s: float
    quotas: dict[str, int]
    used: dict[str, int]
    python: str
    profile: str
    weakest_profile: str
    network: bool
    gpu: bool
    dependencies: bool
    draining: bool

    def enforces(self, profile: str) -> bool:
        """Whether the server can enforce a profile, and its operator permits it."""
        profiles = (self.profile, profile, self.weakest_profile)
        if not all(profile in PROFILES for profile in profiles):
            return False
        strongest, wanted, weakest = map(PROFILES.index, profiles)
        return strongest <= wanted <= weakest


def ask_facts(sandbox: RemoteSandbox) -> ServerFacts:
    """Ask a server for its facts.
    Raises ``SandboxUnavailableError``: no server answers, or it rejects this client;
    ``VersionMismatchError``: server and client share no version of the protocol; ``WorkerError``:
    the server refuses to answer.
    """
    begun, deadline = monotonic(), Deadline(_WAIT_S)
    with _connection(sandbox) as client:
        greeting = m.Hello(m.VERSION, _LOOKER)
        welcome = expect_reply(client.request(greeting, deadline=deadline)[0], m.Welcome)
        answered_s = monotonic() - begun
        sessions = expect_reply(client.request(m.GetSessions(), deadline=deadline)[0], m.Sessions)
    return facts_of(welcome, answered_s, sessions.server)


@contextlib.contextmanager
def _connection(sandbox: RemoteSandbox) -> Iterator[WorkerConnection]:
    never, ends = socket.socketpair()
    with never, ends:
        client = WorkerConnection(sandbox.endpoint, never.fileno(), far=sandbox.far())
        with contextlib.closing(client):
            yield client


def facts_of(welcome: m.Welcome, answered_s: float, said: dict[Any, Any]) -> ServerFacts:
    """Read a server's facts from its answers. Trust: input from the server."""
    clients = said.get("clients")
    mine: object = next(iter(clients.values()), {}) if isinstance(clients, dict) else {}
    words = {name: _text(said.get(name)) for name in _WORDS}
    return ServerFacts(
        version=_text(welcome.worker),
        protocol=welcome.version,
        answered_s=answered_s,
        **words,
        network=said.get("network") is True,
        gpu=said.get("gpu") is True,
        dependencies=said.get("dependencies") is True,
        draining=said.get("draining_s") is not None,
        quotas=_numbers(said.get("quotas")),
        used=_numbers(mine),
    )


def _text(value: object) -> str:
    return printable(value[:_MOST_CHARS]) if isinstance(value, str) else ""


def _numbers(value: object) -> dict[str, int]:
    """Return a mapping's integers within bounds, by name. Trust: input from the server."""
    if not isinstance(value, dict):
        return {}
    items = list(value.items())[:_MOST_NAMES]
    return {
        _text(name): number for name, number in items if type(number) is int and 0 <= number < _MOST
    }

"""``sandbox="tcp://host:5555"``: the worker on another host, over ZeroMQ with CURVE keys.

There ``envhub-worker listen`` runs. The repository's files travel from here, by content, so the
server needs neither the Hub nor a token. A thread of ours tells it that we live; a client that
has gone loses its jails.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from envhub_sandbox.dependencies.pipeline import PackageSet
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import (
    DependencyError,
    EnvHubError,
    PolicyError,
    SandboxUnavailableError,
)
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.log import WORKER
from envhub_sandbox.option_names import option_name
from envhub_sandbox.policy import Policy
from envhub_sandbox.sandboxes import remote_packages, upload
from envhub_sandbox.sandboxes.base import ServerUse
from envhub_sandbox.sandboxes.refcount import Sharing, Use, Uses
from envhub_sandbox.transport.connection import WorkerClient
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.forks import Owner
from envhub_sandbox.transport.tcp import Far
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import parse_key
from envhub_worker.protocol.runtime import OWN, Runtime

SERVER_KEY_VARIABLE = "ENVHUB_SERVER_KEY"
CLIENT_KEY_VARIABLE = "ENVHUB_CLIENT_KEY"
CONFIG_VARIABLE = "ENVHUB_CONFIG"
_KEEP_ALIVE_S = 10.0
_FIRST_S = 0.5
_STOP_S = 1.0
_CLOSE_S = 5.0
_HELLO_S = 30.0
_MAKE_S = 2 * 3600.0


@dataclass
class RemoteSandbox:
    """Workers on another host.

    Attributes:
        endpoint: ``tcp://HOST:PORT`` of its ``envhub-worker listen``.
        server_key: Its public key; by default ``$ENVHUB_SERVER_KEY``, or what ``known_hosts`` in
            the configuration folder says (a line is ``HOST:PORT KEY``).
        client_key: Our secret key, or a file that holds it; by default ``$ENVHUB_CLIENT_KEY``
            (likewise), or ``client.key`` in the configuration folder.
        insecure_loopback: Without keys, for a server on this machine that has none either.
        heartbeat_s: After so many seconds without a sign of life the connection counts as lost.
            On a line where one batch of observations takes longer than that, raise it.
        retry_s: For how long to wait in line when the server has no room for this key; 0, the
            default, raises ``ServerBusyError`` at once.
    """

    endpoint: str
    server_key: str | None = None
    client_key: str | os.PathLike[str] | None = field(default=None, repr=False)
    insecure_loopback: bool = False
    heartbeat_s: float = 30.0
    retry_s: float = 0.0
    name: str = field(default="remote", init=False)
    _orders: dict[str, m.NeedPackages] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        address_of(self.endpoint)
        if self.insecure_loopback and not _is_loopback(self.endpoint):
            raise PolicyError(
                f"insecure_loopback=True is for a server on this machine, and {self.endpoint} is "
                "not on a loopback address: anybody on the way could read and change everything"
            )
        if not self.heartbeat_s > 0:
            raise PolicyError(f"heartbeat_s is {self.heartbeat_s!r}; it takes seconds above 0")
        if not 0 <= self.retry_s < float("inf"):
            raise PolicyError(f"retry_s is {self.retry_s!r}; it takes seconds, or 0 for none")

    def __getstate__(self) -> dict[str, Any]:
        """No secret key is in a pickle: its reader has one, or the file that is named."""
        kept = self.client_key if _is_file(self.client_key) else None
        return {**self.__dict__, "client_key": kept, "_orders": {}}

    def __copy__(self) -> RemoteSandbox:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> RemoteSandbox:
        return replace(self)

    def for_repository(self, snapshot: Path, policy: Policy, runtime: Runtime) -> RemoteRepository:
        """The sandbox for one repository. Connects to nothing.

        Raises:
            PolicyError: The policy names what a client on another host cannot have.
            SandboxUnavailableError: A key is missing.
        """
        check_policy(policy, runtime)
        needed = None
        if runtime.packages:
            needed = Needed(runtime.packages, self._orders[runtime.packages])
        return RemoteRepository(self.endpoint, self.far(), snapshot, policy, self.retry_s, needed)

    def package_target(self) -> RemoteSandbox:
        """The server makes packages itself."""
        return self

    def meets(self, request: PackageRequest) -> bool:
        """Unknown here: the server looks at its own packages when it is asked for some."""
        return False

    def make(self, request: PackageRequest, tell: Callable[[str], None]) -> PackageSet | None:
        """The packages that the server makes; None where its own are enough.

        Raises:
            DependencyError: They cannot be made; the text says what to change.
            PolicyError: The server's operator does not permit it.
            ServerBusyError: Others of the same key are at it.
        """
        order = remote_packages.order_of(request)
        where = (self.endpoint, self.far())
        use = HOSTS.acquire(where, partial(Host, *where))
        host = use.shared
        try:
            client = WorkerClient(self.endpoint, host.stopped, far=host.far)
            with contextlib.closing(client):
                client.hello(Deadline(_HELLO_S))
                made = remote_packages.bring(order, client, Deadline(_MAKE_S), tell)
        finally:
            use.release()
        if made is not None:
            self._orders[made.packages] = order
        return made

    def far(self) -> Far:
        """The server's key and ours.

        Raises:
            SandboxUnavailableError: One is missing.
        """
        if self.insecure_loopback:
            return Far(None, None, self.heartbeat_s)
        server_key = _server_key(self.endpoint, self.server_key)
        return Far(server_key, _client_key(self.client_key), self.heartbeat_s)

    def acquire(self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0) -> ServerUse:
        """Not without a repository: its files have to be brought there."""
        raise SandboxUnavailableError("a remote server is asked for a repository, not for a store")


def check_policy(policy: Policy, runtime: Runtime) -> None:
    """Refuse what names this machine's things; the server would refuse it, too.

    Raises:
        PolicyError: With what to do instead.
    """
    if os.sep in runtime.packages:
        raise PolicyError(
            "dependencies: an environment of this machine is for this machine; a remote server "
            "makes its own, where it was started with --dependencies"
        )
    if runtime.python:
        raise PolicyError(
            f"{option_name('python', runtime.python)} is an interpreter of this machine, and a "
            "remote server has its own: start it in the environment or image that the repository "
            "needs"
        )
    if policy.readable:
        raise PolicyError(
            f"{option_name('readable', list(policy.readable))} are paths of this machine, and a "
            "remote server shows its jails the repository's files only: put what is needed into "
            "the repository"
        )


# --- addresses and keys --------------------------------------------------------------------------


def address_of(endpoint: str) -> str:
    """``host:port`` of an endpoint.

    Raises:
        PolicyError: It is none.
    """
    parts = urlsplit(endpoint)
    if "@" in parts.netloc:
        raise PolicyError(
            "sandbox: a remote server knows its clients by their keys; leave the login before the "
            f"@ out: {without_login(endpoint)!r}"
        )
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme != "tcp" or not parts.hostname or port is None or parts.path:
        raise PolicyError(f"sandbox is {endpoint!r}; a remote server is tcp://HOST:PORT")
    return f"{parts.hostname}:{port}"


def _is_loopback(endpoint: str) -> bool:
    host = urlsplit(endpoint).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def config_folder() -> Path:
    """``$ENVHUB_CONFIG``, or the user's configuration folder for ``envhub-sandbox``."""
    chosen = os.environ.get(CONFIG_VARIABLE)
    if chosen:
        return Path(chosen).expanduser().absolute()
    import platformdirs

    return Path(platformdirs.user_config_dir("envhub-sandbox", appauthor=False))


def _server_key(endpoint: str, given: str | None) -> bytes:
    text = given or os.environ.get(SERVER_KEY_VARIABLE) or _known(address_of(endpoint))
    if not text:
        raise SandboxUnavailableError(
            f"the public key of {endpoint} is not known, and without it anybody could pretend to "
            "be that server. It prints its key when it starts; pass it with "
            f"{option_name('server_key')}, set {SERVER_KEY_VARIABLE}, or write "
            f"'{address_of(endpoint)} KEY' into {config_folder() / 'known_hosts'}"
        )
    return _parsed(text, "server_key")


def _known(address: str) -> str | None:
    with contextlib.suppress(OSError):
        for line in (config_folder() / "known_hosts").read_text().splitlines():
            words = line.split()
            if len(words) == 2 and words[0] == address:
                return words[1]
    return None


def _is_file(key: str | os.PathLike[str] | None) -> bool:
    """Whether it names a key's file, and is not the key."""
    if not isinstance(key, str):
        return key is not None
    try:
        parse_key(key)
    except ValueError:
        return os.sep in key  # anything else may be a key that was mistyped
    return False


def _client_key(given: str | os.PathLike[str] | None) -> bytes:
    default = config_folder() / "client.key"
    text = given or os.environ.get(CLIENT_KEY_VARIABLE) or (default if default.exists() else None)
    if text is None:
        raise SandboxUnavailableError(
            f"a remote server lets only known clients in, and we have no key: run 'envhub-worker "
            f"keygen --out {default.parent}' and give the public key to the server's "
            f"--authorized-clients, or set {CLIENT_KEY_VARIABLE} to the key that the server printed"
        )
    path = Path(text)
    with contextlib.suppress(OSError):
        if isinstance(text, os.PathLike) or os.sep in text or path.is_file():
            return _parsed(path.expanduser().read_text(), "client_key")
    return _parsed(os.fspath(text), "client_key")


def _parsed(text: str, what: str) -> bytes:
    try:
        return parse_key(text)
    except ValueError as error:
        raise PolicyError(f"{what}: {error}") from None


# --- servers ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Needed:
    """Packages that the server has made, and may have to make again.

    Attributes:
        name: What it called them.
        order: What they were made of.
    """

    name: str
    order: m.NeedPackages

    def bring(self, client: WorkerClient, deadline: Deadline) -> None:
        """See that they are there: the server may have been replaced, or have needed the room.

        Raises:
            DependencyError: It would make others today, or can make none.
        """
        made = remote_packages.bring(self.order, client, deadline)
        if made is None or made.packages != self.name:
            raise DependencyError(
                "the server has lost the packages that it had made, and would make others now: "
                "make the environment again"
            )


class RemoteRepository:
    """The sandbox of one repository: its files on the other host.

    Attributes:
        interpreter: Names the server; a remembered manifest holds for this one only.
        retry_s: For how long to wait for room there.
    """

    name = "remote"

    def __init__(
        self,
        endpoint: str,
        far: Far,
        snapshot: Path,
        policy: Policy,
        retry_s: float,
        needed: Needed | None = None,
    ) -> None:
        key = "" if far.server_key is None else far.server_key.hex()
        self.interpreter = f"{endpoint} {key}{'' if needed is None else f' {needed.name}'}"
        self._needed = needed
        self.retry_s = retry_s
        self._endpoint, self._far = endpoint, far
        self._snapshot, self._policy = snapshot, policy
        self._files: tuple[upload.Sent, ...] = ()

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> RemoteServer:
        """The server, which stays for however long; nothing is sent before a jail is opened."""
        where = (self._endpoint, self._far)
        use = HOSTS.acquire(where, partial(Host, *where))
        packages = "" if self._needed is None else self._needed.name
        return RemoteServer(use, self, self._policy.profile, packages)

    def bring(self, client: WorkerClient, deadline: Deadline) -> str:
        """Bring the files there; returns the server's name for them."""
        if self._needed is not None:
            self._needed.bring(client, deadline)
        self._files = self._files or upload.listing(self._snapshot)
        return upload.bring(client, self._snapshot, self._files, deadline)[0]


class RemoteServer:
    """One use of a server on another host, and the server as that use sees it."""

    fd_path = None
    layers: Sequence[Mapping[str, Any]] = ()
    python = ""

    def __init__(
        self, use: Use[Host], repository: RemoteRepository, profile: str, packages: str
    ) -> None:
        self._use = use
        self.host = use.shared
        self.profile = profile
        self.packages = packages
        self.snapshot = ""
        self._repository = repository

    @property
    def shared(self) -> RemoteServer:
        """The server is itself."""
        return self

    @property
    def live(self) -> bool:
        """Whether it has not been given back."""
        return self._use.live

    def release(self) -> None:
        """Give it back; after the last one who does, nobody tells it that we live. Idempotent."""
        self._use.release()

    @property
    def endpoint(self) -> str:
        """Its ZeroMQ endpoint."""
        return self.host.endpoint

    @property
    def far(self) -> Far:
        """Its key and ours."""
        return self.host.far

    @property
    def process_fd(self) -> int:
        """Readable once we have given it up."""
        return self.host.stopped

    def bring(self, client: WorkerClient, deadline: Deadline) -> None:
        """Bring the repository's files there. One of our threads at a time."""
        with self.host.uploading:
            self.snapshot = self._repository.bring(client, deadline)


class Host:
    """A server on another host that environments of this process use."""

    def __init__(self, endpoint: str, far: Far) -> None:
        self.endpoint = endpoint
        self.far = far
        self.uses = Uses()
        self.owner = Owner()
        self.uploading = threading.Lock()
        self._ended = False
        self._wakes: int | None
        self.stopped, self._wakes = os.pipe()
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._keep_alive, name=f"envhub keep-alive {endpoint}", daemon=True
        )
        self._thread.start()

    def _keep_alive(self) -> None:
        """Tell the server that we live, and what we hold; whatever fails is tried again.

        Without this thread the server would end all jails of a client that lives.
        """
        client: WorkerClient | None = None
        every_s = _FIRST_S
        while not self._stop.wait(every_s):
            try:
                if client is None:
                    client = self._connection()
                    client.hello(Deadline(_KEEP_ALIVE_S))
                    every_s = min(_KEEP_ALIVE_S, client.patience_s / 4 or _KEEP_ALIVE_S)
                client.request(m.KeepAlive(tuple(self.far.held)), deadline=Deadline(_KEEP_ALIVE_S))
            except Exception as error:  # of any kind: too few descriptors are a ZMQError
                WORKER.debug("%s was not told that this client lives: %s", self.endpoint, error)
                _close(client)
                client = None
        _close(client)

    def _close_jails(self) -> None:
        """Whatever is open there still: at the end of a process that closed nothing."""
        if not self.far.held:
            return
        client, deadline = self._connection(), Deadline(_CLOSE_S)
        with contextlib.suppress(EnvHubError), contextlib.closing(client):
            client.hello(deadline)
            for jail in tuple(self.far.held):
                client.request(m.CloseJail(jail), deadline=deadline)

    def _connection(self) -> WorkerClient:
        return WorkerClient(self.endpoint, self.stopped, far=self.far)

    @property
    def runs(self) -> bool:
        """Nobody here knows; whoever asks it something hears."""
        return True

    def stop(self) -> None:
        """No longer tell it. A fork of its owner does nothing.

        Idempotent; what interrupts it, it goes on after.
        """
        if self._ended or not self.owner.is_here:
            return
        self._close_jails()
        self._stop.set()
        wakes, self._wakes = self._wakes, None
        if wakes is not None:
            os.close(wakes)  # wakes the thread, should it wait for an answer
        self._thread.join(_STOP_S)
        if not self._thread.is_alive():
            self._ended = True  # once: the number may be somebody else's a moment later
            os.close(self.stopped)


def _close(client: WorkerClient | None) -> None:
    """Close a connection, whatever state it is in."""
    with contextlib.suppress(Exception):
        if client is not None:
            client.close()


HOSTS: Sharing[Host] = Sharing()
"""The servers that this process uses, each once for an endpoint and its keys."""

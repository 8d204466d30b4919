"""The quotas of a client key on a shared server, and the policies that its jails may have."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass as mutable_dataclass
from dataclasses import field

from envhub_worker.extras.access.keys import AuthorizedClients, KeyPair
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import GIB, MIB, PROFILES, Confinement, Limits
from envhub_worker.protocol.messages.server import BUSY_ERROR, Busy
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import size_text
from envhub_worker.supervisor.records import Asker, RefusedError

MAX_CONNECTIONS = 1024
RETRY_S = 1.0
"""How soon a refused client should ask again. One that does not ask again loses its turn."""


class BusyError(RefusedError):
    """The server has no room at present."""

    def __init__(self, busy: Busy, message: str) -> None:
        super().__init__(BUSY_ERROR, message, busy.quota, busy.words())


@dataclass(frozen=True, kw_only=True)
class Quotas:
    """The quotas of one client key, for all its processes together.

    Attributes:
        runners: Runners in its jails.
        memory_bytes: The sum of its open jails' memory limits, and of the slabs that the server
            shares with them. ``processes``, ``open_files``, ``disk_bytes`` and ``disk_files`` are
            sums of their limits, too.
        upload_bytes: Uploaded files of its snapshots; the longest unused are removed first.
        packages_bytes: Its repositories' packages with their downloads; the longest unused are
            removed first.
        inflight_bytes: Requests that its jails have not answered yet.
        sessions: Processes of the client.
    """

    jails: int = 64
    runners: int = 256
    memory_bytes: int = 512 * GIB
    processes: int = 32_768
    open_files: int = 1 << 20
    disk_bytes: int = 512 * GIB
    disk_files: int = 10_000_000
    upload_bytes: int = 8 * GIB
    upload_files: int = 20_000
    packages_bytes: int = 16 * GIB
    inflight_bytes: int = 512 * MIB
    sessions: int = 64


@dataclass(frozen=True, kw_only=True)
class Permissions:
    """The rights that a client's policy may request: the network, GPUs, a weaker profile.
    ``dependencies``: whether packages that repositories declare are installed here.
    """

    weakest_profile: str = "strict"
    network: bool = False
    gpu: bool = False
    dependencies: bool = False


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The configuration of a ``RemoteGate``.

    Attributes:
        keys: The server's key pair; None only for ``--insecure-loopback``.
        operators: Keys that may see all sessions: the server's own.
        idle_s: How long the jails of a silent client live.
        drain_s: How long open jails may go on after the drain has begun.
        profile: The strongest that jails can have here.
    """

    keys: KeyPair | None
    authorized: AuthorizedClients
    operators: frozenset[bytes]
    quotas: Quotas
    permissions: Permissions
    idle_s: int
    max_connections: int = MAX_CONNECTIONS
    drain_s: int = 0
    profile: str = "strict"


_LIMITED = ("memory_bytes", "processes", "open_files", "disk_bytes", "disk_files")
"""Limits of a jail whose sums have a quota of the same name. Of the others, ``cpu_time_s`` is time,
``file_bytes`` is part of the scratch, ``elements`` is the client's own memory, and of messages and
of output the server keeps no more than it has set itself."""

Use = Mapping[str, int]
"""What a jail takes, or further runners of it, by the names of quotas."""


def use_of(limits: Limits, runners: int, shared_bytes: int = 0) -> Use:
    """Returns a jail's share of the quotas; ``shared_bytes``: size of the slabs of its runners."""
    use = {"jails": 1, "runners": runners, **{name: getattr(limits, name) for name in _LIMITED}}
    return {**use, "memory_bytes": limits.memory_bytes + shared_bytes}


def check_policy(request: m.OpenJail, confinement: Confinement, permitted: Permissions) -> None:
    """Refuse a policy with rights that a client on another host may not have. Raises
    ``RefusedError``.
    """
    if "/" in request.runtime.packages:
        raise RefusedError(
            "PolicyError",
            "dependencies: folders of the remote server cannot be named; it makes a repository's "
            "packages itself, where it was started with --dependencies",
        )
    if request.python:
        raise RefusedError("PolicyError", "python: the interpreter is the remote server's own")
    if confinement.readable:
        raise RefusedError("PolicyError", "readable: paths of the remote server cannot be named")
    if confinement.network == "host" and not permitted.network:
        raise RefusedError(
            "PolicyError", "the network 'host' needs a server that was started with --allow-network"
        )
    if confinement.gpu is not False and not permitted.gpu:
        raise RefusedError("PolicyError", "a GPU needs a server that was started with --allow-gpu")
    profile, weakest = confinement.profile, permitted.weakest_profile
    if profile not in PROFILES or PROFILES.index(profile) > PROFILES.index(weakest):
        raise RefusedError(
            "PolicyError",
            f"profile {profile[:20]!r} needs a server that was started with "
            f"--weakest-profile {profile[:20]}; this one permits nothing weaker than {weakest!r}",
        )


def check_jail(open_jails: Iterable[Use], more: Use, quotas: Quotas) -> None:
    """Refuse a jail, or further runners, over the quotas.
    Raises ``RefusedError`` with the exceeded quota.
    """
    uses = list(open_jails)
    for name, added in more.items():
        used, quota = sum(use[name] for use in uses), getattr(quotas, name)
        if used + added > quota:
            shown = size_text if name.endswith("_bytes") else str
            short = name.removesuffix("_bytes").replace("_", " ")
            counted = f"of {short} limits" if name in _LIMITED else short
            text = (
                f"this would make {shown(used + added)} {counted} of your key, over "
                f"the server's quota of {shown(quota)} (--max-{short.replace(' ', '-')}); close "
                "environments, or lower their limits"
            )
            if not uses:
                raise RefusedError("WorkerError", text)  # no waiting makes it fit
            raise BusyError(Busy(short.replace(" ", "_"), used, quota, RETRY_S), text)


@mutable_dataclass
class InFlight:
    """The bytes of unanswered requests, by key."""

    _of: dict[bytes, int] = field(default_factory=dict)
    _requests: dict[tuple[bytes, int], tuple[Asker, bytes, int]] = field(default_factory=dict)

    def of(self, key: bytes) -> int:
        """Returns the bytes in flight of a key."""
        return self._of.get(key, 0)

    def add(self, key: bytes, asker: Asker, size: int, quota: int) -> None:
        """Count a request until it is answered. Raises ``RefusedError``."""
        taken, request = self._of.get(key, 0), (asker.identity, asker.request_id)
        if request in self._requests:
            raise RefusedError("LocalProtocolError", "a request with this id is not answered yet")
        if taken + size > quota:
            text = (
                f"{size_text(taken)} of your key's requests are not answered yet, and "
                f"{size_text(size)} more are over the server's quota of {size_text(quota)}; wait "
                "for replies"
            )
            if not taken:
                raise RefusedError("WorkerError", text)
            raise BusyError(Busy("inflight", taken, quota, RETRY_S), text)
        self._of[key] = taken + size
        self._requests[request] = asker, key, size

    def answered(self, asker: Asker) -> None:
        """Stop counting a request. Another one may have used the same id before."""
        request = (asker.identity, asker.request_id)
        counted, key, size = self._requests.get(request, (None, b"", 0))
        if counted is not asker:
            return
        del self._requests[request]
        self._of[key] -= size
        if not self._of[key]:
            del self._of[key]

"""``sandbox=[...]`` and ``Fleet(...)``: the workers of one environment on many places.

The list of places comes from an argument, a file, or DNS. A file and DNS are asked again whenever a
worker has to be placed. So servers that are added later get workers that are started or brought
back from then on, and what has left the list gets none.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.fleet.member import FleetPackages
from envhub_sandbox.sandboxes.fleet.placement import Placement, Resolve, Seat
from envhub_sandbox.sandboxes.remote import RemoteSandbox
from envhub_sandbox.sandboxes.sandbox import DNS, FILE, Sandbox, is_list
from envhub_sandbox.system.log import WORKER
from envhub_worker.protocol.runtime import Runtime

MOST_PLACES = 4096
_MOST_BYTES = 1 << 20
_FRESH_S = 2.0
"""For how long an answer of DNS holds: many workers start at the same time."""


class PlaceList:
    """The places of a fleet, as they are named. Thread-safe.
    ``source``: a list; ``file:PATH`` or a path; ``dns://HOST:PORT``; or places with commas between.
    """

    def __init__(self, source: str | os.PathLike[str] | Sequence[str | Sandbox]) -> None:
        if isinstance(source, str) and not source.startswith((FILE, DNS)):
            source = [word for word in map(str.strip, source.split(",")) if word]
        self._source = source
        self._last: list[str | Sandbox] = []
        self._known_s = float("-inf")
        self._last = self.read()

    def read(self) -> list[str | Sandbox]:
        """The places that there are now.
        Raises ``PolicyError``: there are none, at first. Later the last ones that there were hold.
        """
        by_name = isinstance(self._source, str) and self._source.startswith(DNS)
        if by_name and self._last and monotonic() - self._known_s < _FRESH_S:
            return self._last
        try:
            self._known_s = monotonic()
            places = self._read()
            if not 0 < len(places) <= MOST_PLACES:
                raise PolicyError(
                    f"a fleet is {self._source!r}, which names {len(places)} places; it takes 1 to "
                    f"{MOST_PLACES}, such as ['tcp://a:5555', 'tcp://b:5555']"
                )
        except (OSError, ValueError) as error:  # of a path that is none, too
            if not self._last:
                if isinstance(error, PolicyError):
                    raise
                raise PolicyError(f"the places of a fleet cannot be read: {error}") from error
            WORKER.warning("the last known places of the fleet hold: %s", error)
            return self._last
        self._last = places
        return places

    def _read(self) -> list[str | Sandbox]:
        source = self._source
        if isinstance(source, os.PathLike):
            return read_file(Path(source))
        if not isinstance(source, str):
            return list(source)
        if source.startswith(FILE):
            return read_file(Path(source.removeprefix(FILE)))
        return read_dns(source)


def read_file(path: Path) -> list[str | Sandbox]:
    """A place on each line, behind an address its public key; ``#`` begins a comment."""
    with path.open("rb") as file:
        data = file.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise PolicyError(f"{path} has more than {_MOST_BYTES} bytes, which no list of places has")
    lines = (line.partition("#")[0] for line in data.decode("utf-8", "replace").splitlines())
    return [" ".join(words) for line in lines if (words := line.split())]


def read_dns(source: str) -> list[str | Sandbox]:
    """An address of each host that a name means, in their order: a headless service's pods."""
    try:
        parts = urlsplit(source)
        host, port, path = parts.hostname, parts.port, parts.path
        if host is not None:
            host.encode("idna")  # as ``getaddrinfo`` does
    except ValueError:
        host = None
    if not host or port is None or path:
        raise PolicyError(f"a fleet is {source!r}; one by DNS is dns://HOST:PORT")
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    hosts = {str(address[0]) for *_, address in found}
    named = {f"[{host}]" if ":" in host else host for host in hosts}
    return [f"tcp://{host}:{port}" for host in sorted(named)]


@dataclass(eq=False)
class Fleet(Sandbox):
    """Several places for the workers of one environment.

    Results, seeds and their order are those of a single place, whatever the places and the number
    of workers. See ``docs/scaling.md``.

    Attributes:
        places: A list of values that ``sandbox`` takes for one place; a place that is listed twice
            gets twice as many workers. Or the path of a file with one place on each line,
            optionally followed by the server's public key; or ``"dns://HOST:PORT"`` for all
            addresses of a DNS name. File and name are read again whenever a worker is started or
            restarted.
        remote: Further arguments of ``RemoteSandbox`` for all places that are addresses.
    """

    places: str | os.PathLike[str] | Sequence[str | Sandbox]
    remote: Mapping[str, Any] = field(default_factory=dict, repr=False)
    name = "fleet"

    def __post_init__(self) -> None:
        if not isinstance(self.places, (os.PathLike, Iterable)):
            raise PolicyError(
                f"a fleet's places are {self.places!r}; they are a list of places, a file with one "
                "on each line, or dns://HOST:PORT"
            )
        known = {one.name for one in fields(RemoteSandbox) if one.init} - {"endpoint"}
        if unknown := sorted(map(repr, set(self.remote) - known)):
            raise PolicyError(
                f"a fleet's remote has {', '.join(unknown)}; RemoteSandbox takes "
                f"{', '.join(sorted(known))}"
            )

    def __getstate__(self) -> dict[str, Any]:
        """No secret key is in a pickle: see ``RemoteSandbox``."""
        probe = RemoteSandbox("tcp://host:1", client_key=self.remote.get("client_key"))
        key = probe.__getstate__()["client_key"]
        return {**self.__dict__, "remote": {**self.remote, "client_key": key}}

    def __copy__(self) -> Fleet:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Fleet:
        return replace(self)

    def opened(self, resolve: Resolve, server_key: str | None) -> OpenFleet:
        """The fleet of one ``make_env``.
        ``resolve``: makes a sandbox of a name that is no address.
        ``server_key``: of places that are addresses, where they do not say another.
        """

        def sandbox_of(place: str | Sandbox) -> Sandbox:
            if is_fleet(place):  # before it is read: a file may name itself
                raise PolicyError("a fleet's places are named one by one: no fleet is one")
            address, _, key = place.partition(" ") if isinstance(place, str) else ("", "", "")
            if not address.startswith("tcp://"):
                return resolve(place)
            known = {"server_key": server_key, **self.remote}
            return RemoteSandbox(address, **(known | {"server_key": key} if key else known))

        return OpenFleet(PlaceList(self.places), sandbox_of)


def is_fleet(place: object) -> bool:
    """Whether this names several places. Reads none of them."""
    return isinstance(place, (list, tuple, Fleet)) or (isinstance(place, str) and is_list(place))


class OpenFleet(Sandbox):
    """The fleet of one ``make_env``: its places, and what was made there for the repository."""

    name = "fleet"

    def __init__(self, places: PlaceList, resolve: Callable[[str | Sandbox], Sandbox]) -> None:
        self._packages = FleetPackages()
        self._placement = Placement(places.read, resolve, self._packages.runtime_of)
        self._packages.members = self._placement.members
        self.is_here = any(member.sandbox.is_here for member in self._placement.members())

    def note_interpreter(self, runtime: Runtime) -> None:
        """See ``Sandbox``."""
        self._packages.host = runtime

    def workers(self, num_workers: int | None) -> list[Seat]:
        """A place for each worker: by default one worker on each."""
        return self._placement.seats(num_workers)

    def package_target(self) -> FleetPackages:
        """See ``Sandbox``: each place has its own."""
        return self._packages

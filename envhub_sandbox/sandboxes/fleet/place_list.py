"""Where the list of a fleet's places comes from: an argument, a file, or DNS.

A file and DNS are asked again whenever a worker has to be placed. So servers that are added later
get workers that are started or brought back from then on, and what has left the list gets none.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from urllib.parse import urlsplit

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.system.log import WORKER

MOST_PLACES = 4096
_FILE, _DNS = "file:", "dns://"
_MOST_BYTES = 1 << 20
_FRESH_S = 2.0
"""For how long an answer of DNS holds: many workers start at the same time."""

Entry = "str | Sandbox"


class PlaceList:
    """The places of a fleet, as they are named. Thread-safe.

    Args:
        source: A list; ``file:PATH`` or a path; ``dns://HOST:PORT``; or places with commas between.
    """

    def __init__(self, source: str | os.PathLike[str] | Sequence[str | Sandbox]) -> None:
        if isinstance(source, str) and not source.startswith((_FILE, _DNS)):
            source = [word for word in map(str.strip, source.split(",")) if word]
        self._source = source
        self._last: list[str | Sandbox] = []
        self._known_s = float("-inf")
        self._last = self.read()

    def read(self) -> list[str | Sandbox]:
        """The places that there are now.

        Raises:
            PolicyError: There are none, at first. Later the last ones that there were hold.
        """
        by_name = isinstance(self._source, str) and self._source.startswith(_DNS)
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
        if source.startswith(_FILE):
            return read_file(Path(source.removeprefix(_FILE)))
        return read_dns(source)


def is_list(text: str) -> bool:
    """Whether a text names several places, or where they are listed."""
    return "," in text or text.startswith((_FILE, _DNS))


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

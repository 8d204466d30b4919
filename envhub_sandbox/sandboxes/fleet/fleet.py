"""``sandbox=[...]`` and ``Fleet(...)``: the workers of one environment on many places."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.fleet.packages import FleetPackages
from envhub_sandbox.sandboxes.fleet.place_list import PlaceList, is_list
from envhub_sandbox.sandboxes.fleet.placement import Placement, Resolve, Seat
from envhub_sandbox.sandboxes.remote import RemoteSandbox
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_worker.protocol.runtime import Runtime


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

        Args:
            resolve: Makes a sandbox of a name that is no address.
            server_key: Of places that are addresses, where they do not say another.
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
        self._placement = Placement(places, resolve, self._packages.runtime_of)
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

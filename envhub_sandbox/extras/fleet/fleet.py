"""``sandbox=[...]`` and ``Fleet(...)``: the workers of one environment on many places."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.extras.fleet.member import FleetPackages
from envhub_sandbox.extras.fleet.placement import Placement, Resolve, Seat
from envhub_sandbox.extras.remote.sandbox import RemoteSandbox
from envhub_sandbox.sandboxes.sandbox import Sandbox, is_list
from envhub_worker.protocol.runtime import Runtime

MOST_PLACES = 4096


def places_of(source: str | Sequence[str | Sandbox]) -> list[str | Sandbox]:
    """Read the places from a list, or from a text with commas between them.
    Raises ``PolicyError``: there are no places, or too many.
    """
    if isinstance(source, str):
        source = [word for word in map(str.strip, source.split(",")) if word]
    places = list(source)
    if not 0 < len(places) <= MOST_PLACES:
        raise PolicyError(
            f"a fleet names {len(places)} places; it takes 1 to {MOST_PLACES}, such as "
            "['tcp://a:5555', 'tcp://b:5555']"
        )
    return places


@dataclass(eq=False)
class Fleet(Sandbox):
    """Several places for the workers of one environment.

    Results, seeds and their order equal those of a single place; they do not depend on the places
    or the number of workers. See ``docs/scaling.md``.

    Attributes:
        places: A list of values that ``sandbox`` takes for one place, or a text with commas between
            the places. A place that is listed twice gets twice as many workers. The server's public
            key may follow an address: ``"tcp://HOST:PORT KEY"``.
        remote: Further arguments of ``RemoteSandbox`` for every place that is an address.
    """

    places: str | Sequence[str | Sandbox]
    remote: Mapping[str, Any] = field(default_factory=dict, repr=False)
    name = "fleet"

    def __post_init__(self) -> None:
        if not isinstance(self.places, Iterable):
            raise PolicyError(
                f"a fleet's places are {self.places!r}; they are a list, or text with commas"
            )
        permitted = {option.name for option in fields(RemoteSandbox) if option.init} - {"endpoint"}
        if unknown := sorted(map(repr, set(self.remote) - permitted)):
            raise PolicyError(
                f"a fleet's remote has {', '.join(unknown)}; RemoteSandbox takes "
                f"{', '.join(sorted(permitted))}"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Leave a secret key out of the pickle: see ``RemoteSandbox``."""
        probe = RemoteSandbox("tcp://host:1", client_key=self.remote.get("client_key"))
        key = probe.__getstate__()["client_key"]
        return {**self.__dict__, "remote": {**self.remote, "client_key": key}}

    def __copy__(self) -> Fleet:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Fleet:
        return replace(self)

    def opened(self, resolve: Resolve) -> OpenFleet:
        """Make the fleet of one ``make_env``.
        ``resolve``: makes the sandbox of a place that is not a ``tcp://`` address.
        """

        def sandbox_of(sandbox: str | Sandbox) -> Sandbox:
            if isinstance(sandbox, (list, tuple, Fleet)) or (
                isinstance(sandbox, str) and is_list(sandbox)
            ):
                raise PolicyError("a fleet cannot be a place of a fleet: name its places")
            if isinstance(sandbox, str) and sandbox.startswith("tcp://"):
                return RemoteSandbox(sandbox, **self.remote)
            return resolve(sandbox)

        return OpenFleet(places_of(self.places), sandbox_of)


class OpenFleet(Sandbox):
    """The fleet of one ``make_env``: its places, and the packages that they made for it."""

    name = "fleet"

    def __init__(self, places: Sequence[str | Sandbox], resolve: Resolve) -> None:
        self._packages = FleetPackages()
        self._placement = Placement(places, resolve, self._packages.runtime_of)
        self._packages.members = self._placement.members
        self.is_here = any(member.sandbox.is_here for member in self._placement.members())

    def note_interpreter(self, runtime: Runtime) -> None:
        """See ``Sandbox``."""
        self._packages.host = runtime

    def workers(self, num_workers: int | None) -> list[Seat]:
        """See ``Sandbox``: a seat for each worker; by default one worker for each listed place."""
        return self._placement.seats(num_workers)

    def package_target(self) -> FleetPackages:
        """See ``Sandbox``: makes the packages on every place."""
        return self._packages

"""A repository's packages on each place of a fleet, as that place makes them."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox.dependencies.packages import PackageSet
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import DependencyError, PolicyError
from envhub_sandbox.sandboxes.fleet.member import FleetPackages, Member
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.transport.tcp import UnreachableError
from envhub_worker.protocol.runtime import Runtime


class _Place(Sandbox):
    """A place whose packages are as a test says; None: it has its own only."""

    def __init__(self, name: str, made: Any, *, meets: bool = False, here: bool = False) -> None:
        self.name, self.is_here = name, here
        self._made, self._meets = made, meets
        self.asked = 0

    def will_make(self, made: Any) -> None:
        self._made = made

    def package_target(self) -> Any:
        return None if self._made is None else self

    def meets(self, request: PackageRequest) -> bool:
        return self._meets

    def make(self, request: PackageRequest, tell: Any) -> Any:
        self.asked += 1
        if isinstance(self._made, Exception):
            raise self._made
        return self._made


def _request(*, always: bool = False) -> PackageRequest:
    request: Any = type("Request", (), {"always": always})()
    return request  # type: ignore[no-any-return]


def _packages(*places: _Place) -> tuple[FleetPackages, list[Member]]:
    packages = FleetPackages()
    members = [Member(place, packages.runtime_of) for place in places]
    packages.members = lambda: members
    return packages, members


def test_each_place_runs_on_its_own() -> None:
    """A folder here, a name over there; the facts of each are kept, and told once if alike."""
    here = _Place("here", PackageSet("/made/here", {"lock": "a"}, "/python"), here=True)
    there = _Place("there", PackageSet("name", {"lock": "b"}))
    packages, members = _packages(here, there)
    made = packages.make(_request(), print)
    assert made is not None
    assert packages.runtime_of(members[0]) == Runtime("/python", "/made/here")
    assert packages.runtime_of(members[1]) == Runtime("", "name")
    assert made.facts["places"] == {"here": {"lock": "a"}, "there": {"lock": "b"}}
    there.will_make(PackageSet("name", {"lock": "a"}))
    made = packages.make(_request(), print)
    assert made is not None
    assert made.facts == {"lock": "a"}


def test_what_a_place_has_is_not_made() -> None:
    """Its own interpreter runs it then: here the one that the caller named."""
    here, there = _Place("here", 1, meets=True, here=True), _Place("there", 1, meets=True)
    packages, members = _packages(here, there)
    packages.host = Runtime("/named")
    assert packages.meets(_request())
    assert packages.make(_request(), print) is None
    assert here.asked == there.asked == 0
    assert [packages.runtime_of(one) for one in members] == [Runtime("/named"), Runtime("")]


def test_one_that_is_not_there_makes_them_when_it_is_used() -> None:
    absent = _Place("absent", UnreachableError("nothing answers"))
    packages, members = _packages(_Place("here", PackageSet("x", {})), absent)
    assert packages.make(_request(), print) is not None
    absent.will_make(PackageSet("later", {}))
    assert packages.runtime_of(members[1]) == Runtime("", "later")
    assert absent.asked == 2


def test_one_that_cannot_make_them_is_an_error() -> None:
    packages, _ = _packages(
        _Place("a", PackageSet("x", {})), _Place("b", DependencyError("no wheel"))
    )
    with pytest.raises(DependencyError, match="no wheel"):
        packages.make(_request(), print)
    without, _ = _packages(_Place("own", None))
    with pytest.raises(PolicyError, match="own has packages of its own"):
        without.make(_request(always=True), print)
    assert not without.meets(_request())

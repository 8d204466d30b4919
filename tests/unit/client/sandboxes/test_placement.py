"""Which worker goes where: fewest of the fleet first, then most room; then the next place."""

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError, PolicyError
from envhub_sandbox.extras.fleet import placement as module
from envhub_sandbox.extras.fleet.member import FleetPackages, Member
from envhub_sandbox.extras.fleet.placement import Placement, Room
from envhub_sandbox.extras.packages.packages import PackageSet
from envhub_sandbox.extras.packages.request import PackageRequest
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.transport.replies import UnreachableError
from envhub_worker.protocol.runtime import Runtime


class _Place(Sandbox):
    def __init__(self, name: str) -> None:
        self.name = name
        self.refuses, self.asked = False, 0

    def runs_on(self, runtime: Runtime) -> Runtime:
        self.asked += 1
        return Runtime(f"tcp://{self.name} {'k' * 64}" if self.name.startswith("far") else "")

    def for_repository(self, *given: Any) -> Sandbox:
        if self.refuses:
            raise PolicyError(f"{self.name} cannot permit that")
        return self


class _Rooms:
    """The rooms that a test says."""

    def __init__(self, memory_bytes: int) -> None:
        self.said: dict[str, Room] = {}

    def ask(self, members: list[Member]) -> dict[Member, Room]:
        return {one: self.said[one.name] for one in members if one.name in self.said}


@pytest.fixture
def rooms(monkeypatch: pytest.MonkeyPatch) -> dict[str, Room]:
    made = _Rooms(0)
    monkeypatch.setattr(module, "Rooms", lambda memory_bytes: made)
    return made.said


def _placement(names: list[str]) -> Placement:
    known = {name: _Place(name) for name in names}

    def resolve(place: Any) -> Sandbox:
        return known[place]

    return Placement(names, resolve, lambda member: Runtime(""))


def _opened(names: list[str]) -> Placement:
    made = _placement(names)
    [seat, *_] = made.seats(None)
    seat.for_repository(Path(), Policy(), Runtime(""))
    return made


def _first(placement: Placement, number: int) -> str:
    return next(placement.candidates(number)).name


def test_they_are_spread(rooms: dict[str, Room]) -> None:
    """One each by default; evenly, by how often a place is in the list."""
    assert len(_placement(["a", "b", "a"]).seats(None)) == 3
    assert len(_placement(["a", "b"]).seats(5)) == 5
    placement = _opened(["a", "b", "a"])
    found = [_first(placement, number) for number in range(6)]
    assert sorted(found) == ["a", "a", "a", "a", "b", "b"]


def test_the_place_with_most_room_comes_first(rooms: dict[str, Room]) -> None:
    """Then what is full, and what does not answer; room that was given away since is gone."""
    rooms |= {"a": Room(workers=1), "b": Room(workers=9)}
    rooms |= {"c": Room(workers=0), "d": Room(answers=False, workers=0)}
    placement = _opened(["c", "d", "a", "b"])
    assert [one.name for one in placement.candidates(0)] == ["b", "a", "c", "d"]
    placement = _opened(["a", "b"])
    assert [_first(placement, number) for number in range(4)] == ["b", "a", "b", "b"]


def test_a_claim_of_endless_room_attracts_no_more(rooms: dict[str, Room]) -> None:
    """A server may say what it likes: it gets its share of the workers."""
    rooms |= {"a": Room(workers=1 << 62), "b": Room(workers=8)}
    placement = _opened(["a", "b"])
    assert sorted(_first(placement, number) for number in range(8)) == ["a"] * 4 + ["b"] * 4


def test_a_worker_comes_back_to_where_it_was(rooms: dict[str, Room]) -> None:
    """Also where another has more room; but not where that does not answer, or is full."""
    placement = _opened(["a", "b"])
    assert _first(placement, 0) == "a"
    rooms |= {"a": Room(workers=1), "b": Room(workers=9)}
    assert _first(placement, 0) == "a"
    rooms["a"] = Room(answers=False, workers=0)
    assert _first(placement, 0) == "b"


def test_where_a_worker_is(rooms: dict[str, Room]) -> None:
    placement = _opened(["a", "b"])
    assert [placement.at(number).name for number in range(3)] == ["a", "b", "a"]
    tries = placement.candidates(0)
    assert [next(tries).name, next(tries).name] == ["a", "b"]
    assert placement.at(0).name == "b"


def test_a_place_that_was_absent_is_made_when_it_is_used(rooms: dict[str, Room]) -> None:
    """Packages could not be made there: the others are used without it, and it comes last."""
    placement = _placement(["a", "b", "c"])
    [a, b, c] = placement.members()
    a.absent = c.absent = True
    rooms |= {one: Room(answers=False, workers=0) for one in "ac"}
    placement.seats(None)[0].for_repository(Path(), Policy(), Runtime(""))
    assert [one.is_open for one in (a, b, c)] == [False, True, False]
    assert [placement.at(number).name for number in range(2)] == ["b", "b"]
    vars(c.sandbox)["refuses"] = True
    assert [one.name for one in placement.candidates(0)] == ["b", "a"]
    assert [one.is_open for one in (a, b, c)] == [True, True, False]
    assert placement.at(0).is_open, "where a worker is held there is a place"


def test_all_are_made_where_none_was_there(rooms: dict[str, Room]) -> None:
    placement = _placement(["a", "b"])
    for one in placement.members():
        one.absent = vars(one.sandbox)["refuses"] = True
    with pytest.raises(PolicyError, match="a cannot"):
        placement.seats(None)[0].for_repository(Path(), Policy(), Runtime(""))


def test_what_many_places_run_on_has_a_name_of_a_file(rooms: dict[str, Room]) -> None:
    """It is looked up as one; the same places have the same, in any order. What places run on that
    are alike is that of one: a remembered manifest then holds for both."""
    assert _opened(["a", "b"]).runs_on(Runtime("")) == Runtime("")
    names = [f"far{number}" for number in range(300)]
    found = [_opened(some).runs_on(Runtime("")) for some in (names, names[::-1], names[1:])]
    assert found[0] == found[1] != found[2]
    assert not Path(found[0].python).exists()
    assert list(Path(found[0].python).parent.glob("none")) == []


def test_a_place_is_asked_once_for_all_workers(rooms: dict[str, Room]) -> None:
    placement = _placement([f"far{number}" for number in range(50)])
    for seat in placement.seats(None):
        seat.for_repository(Path(), Policy(), Runtime("")).runs_on(Runtime(""))
    assert {vars(member.sandbox)["asked"] for member in placement.members()} == {1}


def test_not_all_silent_are_asked(rooms: dict[str, Room], monkeypatch: pytest.MonkeyPatch) -> None:
    """A name of DNS may have thousands of addresses; each group of them costs a wait."""
    names = [f"far{number:03}" for number in range(100)]
    rooms |= dict.fromkeys(names, Room(answers=False, workers=0)) | {"far099": Room(workers=1)}
    assert _first(_opened(names), 0) == "far099"  # the control
    monkeypatch.setattr(module, "ASK_S", 0)
    assert _first(_opened(names), 0) == "far000"


# --- A repository's packages on each place of a fleet, as that place makes them


class _Maker(Sandbox):
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
    return request


def _packages(*places: _Maker) -> tuple[FleetPackages, list[Member]]:
    packages = FleetPackages()
    members = [Member(place, packages.runtime_of) for place in places]
    packages.members = lambda: members
    return packages, members


def test_each_place_runs_on_its_own() -> None:
    """A folder here, a name over there; the facts of each are kept, and told once if alike."""
    here = _Maker("here", PackageSet("/made/here", {"lock": "a"}, "/python"), here=True)
    there = _Maker("there", PackageSet("name", {"lock": "b"}))
    packages, members = _packages(here, there)
    made = packages.make(_request(), print)
    assert made is not None
    assert packages.runtime_of(members[0]) == Runtime("/python", "/made/here")
    assert packages.runtime_of(members[1]) == Runtime("", "name")
    assert made.facts["places"] == {"here": {"lock": "a"}, "there": {"lock": "b"}}
    there.will_make(PackageSet("name", {"lock": "a"}))
    made = packages.make(_request(), print)
    assert made.facts == {"lock": "a"}


def test_what_a_place_has_is_not_made() -> None:
    """Its own interpreter runs it then: here the one that the caller named."""
    here, there = _Maker("here", 1, meets=True, here=True), _Maker("there", 1, meets=True)
    packages, members = _packages(here, there)
    packages.host = Runtime("/named")
    assert packages.meets(_request())
    assert packages.make(_request(), print) is None
    assert here.asked == there.asked == 0
    assert [packages.runtime_of(one) for one in members] == [Runtime("/named"), Runtime("")]


def test_one_that_is_not_there_makes_them_when_it_is_used() -> None:
    absent = _Maker("absent", UnreachableError("nothing answers"))
    packages, members = _packages(_Maker("here", PackageSet("x", {})), absent)
    assert packages.make(_request(), print) is not None
    absent.will_make(PackageSet("later", {}))
    assert packages.runtime_of(members[1]) == Runtime("", "later")
    assert absent.asked == 2


def test_one_that_cannot_make_them_is_an_error() -> None:
    packages, _ = _packages(
        _Maker("a", PackageSet("x", {})), _Maker("b", DependencyError("no wheel"))
    )
    with pytest.raises(DependencyError, match="no wheel"):
        packages.make(_request(), print)
    without, _ = _packages(_Maker("own", None))
    with pytest.raises(PolicyError, match="own has packages of its own"):
        without.make(_request(always=True), print)
    assert not without.meets(_request())

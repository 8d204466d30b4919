"""Places of a fleet by their names, and their list: an argument, a file, DNS."""

from __future__ import annotations

import copy
import pickle
import socket
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import (
    EnvHubError,
    LoadError,
    PolicyError,
    SandboxUnavailableError,
    ServerBusyError,
    WorkerDiedError,
    WorkerStartupError,
    WorkerTimeoutError,
)
from envhub_sandbox.factory.make_env import sandbox_of
from envhub_sandbox.sandboxes.fleet import fleet
from envhub_sandbox.sandboxes.fleet.fleet import Fleet, PlaceList, read_dns
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.sandboxes.sandbox import is_list, may_go_elsewhere, worst_of
from envhub_sandbox.transport.replies import UnreachableError
from envhub_worker.access import keys
from envhub_worker.protocol.keys import key_text
from tests.support import inside


def test_a_fleet_is_no_place_of_another(tmp_path: Path) -> None:
    """Neither at first, nor as a line that a list gets later; nor is a list one of itself."""
    other, path = tmp_path / "other", tmp_path / "places"
    other.write_text("tcp://c:1\n")
    path.write_text(f"file:{path}\n")
    resolve = partial(sandbox_of, server_key=None)
    for nested in (Fleet(["tcp://a:1"]), f"file:{other}", f"file:{path}"):
        with pytest.raises(PolicyError, match="no fleet"):
            Fleet([nested]).opened(resolve, None)
    path.write_text("tcp://a:1\n")
    opened = Fleet(path).opened(resolve, None)
    path.write_text(f"file:{other}\nfile:{path}\ntcp://a:1\ntcp://b:1,file:{path}\ntcp://b:1\n")
    assert [seat.address for seat in opened.workers(None)] == ["tcp://a:1", "tcp://b:1"]


@pytest.mark.parametrize(
    ("places", "remote", "said"),
    [
        (None, {}, "places are None"),
        (3, {}, "places are 3"),
        (["tcp://a:1"], {"server": "x"}, "'server'.*server_key"),
        (["tcp://a:1"], {"endpoint": "tcp://b:1", 1: 2}, "'endpoint', 1;"),
    ],
)
def test_what_is_no_fleet_says_what_is_one(places: Any, remote: Any, said: str) -> None:
    """When it is made, and before anything is started."""
    with pytest.raises(PolicyError, match=said):
        Fleet(places, remote)


def test_a_secret_key_is_in_copies_and_in_no_pickle() -> None:
    pair = keys.generate()
    text = key_text(pair.secret)
    fleet = Fleet(["tcp://a:1"], remote={"client_key": text})
    for copied in (copy.copy(fleet), copy.deepcopy(fleet)):
        assert copied.remote == {"client_key": text}
    data = pickle.dumps(fleet)
    assert not [one for one in (text.encode(), pair.secret) if one in data]
    assert pickle.loads(data).places == ["tcp://a:1"]
    assert text not in repr(fleet)


def test_places_stand_in_a_list_a_text_or_a_file(tmp_path: Path) -> None:
    """In their order, also twice; behind an address its key. Comments and empty lines are none."""
    given = ["tcp://a:1", PROCESS, "tcp://a:1"]
    assert PlaceList(given).read() == given
    assert PlaceList(Fleet(dict.fromkeys(given)).places).read() == ["tcp://a:1", PROCESS]
    assert PlaceList("tcp://a:1, process,").read() == ["tcp://a:1", "process"]
    path = tmp_path / "places"
    path.write_text("# all\n\ntcp://a:1   KEY # the first\n  process\n")
    for source in (path, f"file:{path}"):
        assert PlaceList(source).read() == ["tcp://a:1 KEY", "process"]
    assert all(map(is_list, ["tcp://a:1,tcp://b:1", "file:x", "dns://x:1"]))
    assert not any(map(is_list, ["process", "docker:image", "tcp://a:1"]))


def test_a_file_is_read_again(tmp_path: Path) -> None:
    """What it says now holds; where it says nothing, what it said last."""
    path = tmp_path / "places"
    path.write_text("tcp://a:1\n")
    places = PlaceList(path)
    path.write_text("tcp://b:1\n")
    assert places.read() == ["tcp://b:1"]
    path.write_text("# in the midst of being written\n")
    assert places.read() == ["tcp://b:1"]
    path.unlink()
    assert places.read() == ["tcp://b:1"]
    path.write_bytes(b"x\n" * fleet.MOST_PLACES * 2)
    assert places.read() == ["tcp://b:1"]


@pytest.mark.parametrize(
    "source",
    [
        *([], "", ",", "file:/there/is/none", "file:/a\0b", "dns://nohost", "dns://h:x"),
        *("dns://[", f"dns://{'a' * 70}:5", "dns://a..b:5", "dns://\u2100:5"),
    ],
)
def test_no_places_at_first_are_refused(source: Any) -> None:
    with pytest.raises(PolicyError, match="fleet"):
        PlaceList(source)


def test_a_list_without_bounds_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="4097 places"):
        PlaceList(["process"] * (fleet.MOST_PLACES + 1))
    path = tmp_path / "places"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(PolicyError, match="bytes"):
        PlaceList(path)


def test_dns_gives_each_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each once, in an order of their own; a later failure changes nothing."""
    answers: list[Any] = [["10.0.0.2", "10.0.0.1", "10.0.0.2"], ["fd00::1"], None]

    def look_up(host: str, port: int, **_: Any) -> list[Any]:
        assert (host, port) == ("workers.default", 5555)
        answer = answers.pop(0)
        if answer is None:
            raise socket.gaierror("not now")
        return [(None, None, None, "", (one, port)) for one in answer]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    source = "dns://workers.default:5555"
    assert read_dns(source) == ["tcp://10.0.0.1:5555", "tcp://10.0.0.2:5555"]
    monkeypatch.setattr(*inside.freshness_of_dns(), 0)
    places = PlaceList(source)
    assert places.read() == ["tcp://[fd00::1]:5555"]


# --- When another place of a fleet is worth a try, and what is said where none takes a worker


BUSY = ServerBusyError("a: no room")


@pytest.mark.parametrize(
    ("error", "elsewhere"),
    [
        (BUSY, True),
        (UnreachableError("nothing answers"), True),
        (WorkerStartupError("it did not start"), True),
        (WorkerDiedError("lost", reason="connection"), True),
        (WorkerDiedError("ended", reason="server"), True),
        (WorkerTimeoutError("the worker did not answer in time"), True),
        (LoadError("the repository failed"), False),
        (WorkerDiedError("it was killed", reason="signal"), False),
        (WorkerTimeoutError("make_env takes too long", request="make_env"), False),
        (SandboxUnavailableError("the server does not know our key"), False),
        (PolicyError("not permitted"), False),
    ],
)
def test_a_place_that_is_full_or_not_there_is_followed_by_the_next(
    error: EnvHubError, elsewhere: bool
) -> None:
    """What would be the same elsewhere is not tried again, or is a mistake to be known."""
    assert may_go_elsewhere(error) is elsewhere


def test_the_error_for_all_is_one_that_may_pass() -> None:
    """With what each place has said; a single place's error stays as it is."""
    lost = WorkerDiedError("b: lost\nmore of it", reason="connection")
    found = worst_of([lost, BUSY])
    assert found is BUSY
    assert str(found) == "a: no room\nThe other places of the fleet:\nb: lost"
    assert worst_of([lost]) is lost
    assert str(lost) == "b: lost\nmore of it"

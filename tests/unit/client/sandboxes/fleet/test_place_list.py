"""The list of a fleet's places: an argument, a file that is looked at again, or DNS."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.fleet import place_list
from envhub_sandbox.sandboxes.fleet.place_list import PlaceList, is_list, read_dns
from envhub_sandbox.sandboxes.process import PROCESS
from tests.support import inside


def test_a_list_is_as_it_was_given() -> None:
    """Names and sandboxes, in their order, also twice."""
    given = ["tcp://a:1", PROCESS, "tcp://a:1"]
    assert PlaceList(given).read() == given
    assert PlaceList("tcp://a:1, process,").read() == ["tcp://a:1", "process"]


def test_a_file_has_one_on_each_line(tmp_path: Path) -> None:
    """Behind an address its key; comments and empty lines are none."""
    path = tmp_path / "places"
    path.write_text("# all\n\ntcp://a:1   KEY # the first\n  process\n")
    for source in (path, f"file:{path}"):
        assert PlaceList(source).read() == ["tcp://a:1 KEY", "process"]


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
    path.write_bytes(b"x\n" * place_list.MOST_PLACES * 2)
    assert places.read() == ["tcp://b:1"]


@pytest.mark.parametrize(
    "source",
    [
        *([], "", ",", "file:/there/is/none", "file:/a\0b", "dns://nohost", "dns://h:x"),
        *("dns://[", f"dns://{'a' * 70}:5", "dns://a..b:5", "dns://\u2100:5"),
    ],
)
def test_no_places_at_first_are_refused(source: Any) -> None:
    """There is nothing that could hold instead."""
    with pytest.raises(PolicyError, match="fleet"):
        PlaceList(source)


def test_too_many_are_refused() -> None:
    """A list of so many is a mistake."""
    with pytest.raises(PolicyError, match="4097 places"):
        PlaceList(["process"] * (place_list.MOST_PLACES + 1))


def test_a_huge_file_is_not_read_whole(tmp_path: Path) -> None:
    """It is no list of places."""
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


def test_what_names_several() -> None:
    """A text with commas, a file, a name of DNS; one place is none of these."""
    assert all(map(is_list, ["tcp://a:1,tcp://b:1", "file:x", "dns://x:1"]))
    assert not any(map(is_list, ["process", "docker:image", "tcp://a:1"]))

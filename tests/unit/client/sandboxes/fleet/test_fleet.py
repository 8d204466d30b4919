"""Places of a fleet by their names."""

from __future__ import annotations

import copy
import pickle
from functools import partial
from pathlib import Path

import pytest

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.factory.arguments import sandbox_of
from envhub_sandbox.sandboxes.fleet.fleet import Fleet
from envhub_worker.access import keys
from envhub_worker.protocol.keys import key_text


def test_a_fleet_is_no_place_of_another(tmp_path: Path) -> None:
    """Neither at first, nor as a line that a list gets later."""
    other, path = tmp_path / "other", tmp_path / "places"
    other.write_text("tcp://c:1\n")
    path.write_text("tcp://a:1\n")
    resolve = partial(sandbox_of, server_key=None)
    for nested in (Fleet(["tcp://a:1"]), f"file:{other}"):
        with pytest.raises(PolicyError, match="no fleet"):
            Fleet([nested]).opened(resolve, None)
    opened = Fleet(path).opened(resolve, None)
    path.write_text(f"file:{other}\ntcp://a:1\ntcp://b:1\n")
    assert [seat.address for seat in opened.workers(None)] == ["tcp://a:1", "tcp://b:1"]


def test_a_list_that_names_itself_is_no_place(tmp_path: Path) -> None:
    """Neither at first nor later: what is no place is not read."""
    path = tmp_path / "places"
    resolve = partial(sandbox_of, server_key=None)
    path.write_text(f"file:{path}\n")
    with pytest.raises(PolicyError, match="no fleet"):
        Fleet(path).opened(resolve, None)
    path.write_text("tcp://a:1\n")
    opened = Fleet(path).opened(resolve, None)
    path.write_text(f"file:{path}\ntcp://a:1\ntcp://b:1,file:{path}\ntcp://b:1\n")
    assert [seat.address for seat in opened.workers(None)] == ["tcp://a:1", "tcp://b:1"]


def test_a_secret_key_is_in_copies_and_in_no_pickle() -> None:
    """A copy is of this process, as that of a RemoteSandbox is."""
    pair = keys.generate()
    text = key_text(pair.secret)
    fleet = Fleet(["tcp://a:1"], remote={"client_key": text})
    for copied in (copy.copy(fleet), copy.deepcopy(fleet)):
        assert copied.remote == {"client_key": text}
    data = pickle.dumps(fleet)
    assert not [one for one in (text.encode(), pair.secret) if one in data]
    assert pickle.loads(data).places == ["tcp://a:1"]
    assert text not in repr(fleet)

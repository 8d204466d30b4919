"""Keys as text, and the list of clients: whose may come in, and what of one that is broken."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest
import zmq
from zmq.utils import z85

from envhub_worker.extras.access import keys
from envhub_worker.extras.access.keys import AuthorizedClients
from envhub_worker.protocol.keys import key_text, parse_key

ALICE, BOB = keys.generate().public, keys.generate().public


def write(path: Path, lines: Sequence[str], encoding: str = "utf-8") -> None:
    """Replaced as a whole, as an editor does it: the clock need not have moved on."""
    new = path.with_suffix(".new")
    new.write_text("".join(f"{line}\n" for line in lines), encoding)
    os.replace(new, path)


def test_keys_are_read_in_both_forms() -> None:
    for _ in range(20):
        public, secret = zmq.curve_keypair()
        assert parse_key(public.decode()) == z85.decode(public)
        assert parse_key(f" {z85.decode(secret).hex()}\n") == z85.decode(secret)
        pair = keys.from_secret(z85.decode(secret))
        assert pair.public == z85.decode(public)
        assert str(pair.secret) not in repr(pair)


@pytest.mark.parametrize("text", ["", "00", "g" * 64, "0" * 63, " " * 40, "~" * 40, "#" * 40])
def test_what_is_no_key_is_refused_without_being_repeated(text: str) -> None:
    with pytest.raises(ValueError, match="64 hexadecimal digits") as caught:
        parse_key(text)
    assert not text.strip() or text not in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_the_list_of_clients_knows_names_and_comments(tmp_path: Path, encoding: str) -> None:
    """Names in any script; a key in Z85 may begin like a comment."""
    path = tmp_path / "clients"
    bob = z85.encode(BOB).decode()
    lines = ["# comment", "#comment", "", f"{key_text(ALICE)} Zoë 小林 in lab 3", bob]
    write(path, lines, encoding)
    found = AuthorizedClients(path, {})
    assert (found.name_of(ALICE), found.name_of(BOB)) == ("Zoë 小林 in lab 3", key_text(BOB)[:8])
    assert found.name_of(keys.generate().public) is None


def test_a_broken_list_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "clients"
    write(path, [f"{key_text(ALICE)} alice"])
    found = AuthorizedClients(path, {})
    assert not found.refresh()
    write(path, [f"{key_text(ALICE)} alice", "no key"])
    with pytest.raises(ValueError, match="line 2") as first:
        found.refresh()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", _not_again)
        with pytest.raises(ValueError, match="line 2") as second:
            found.refresh()
    assert str(first.value) == str(second.value)
    assert found.name_of(ALICE) == "alice"
    write(path, [f"{key_text(BOB)} bob"])
    assert found.refresh()
    assert (found.name_of(ALICE), found.name_of(BOB), found.count) == (None, "bob", 1)


def _not_again(*_: object, **__: object) -> None:
    raise AssertionError("it was opened again")

"""The list of clients: whose keys may come in, and what becomes of one that is broken."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from envhub_worker.access import keys
from envhub_worker.access.keys import AuthorizedClients
from envhub_worker.protocol.keys import key_text

ALICE, BOB = keys.generate().public, keys.generate().public


def write(path: Path, lines: Sequence[str], encoding: str = "utf-8") -> None:
    """Replaced as a whole, as an editor does it: the clock need not have moved on."""
    new = path.with_suffix(".new")
    new.write_text("".join(f"{line}\n" for line in lines), encoding)
    os.replace(new, path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_names_are_text_in_any_script(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "clients"
    write(path, [f"{key_text(ALICE)} Zoë Łukasz", f"{key_text(BOB)} 小林"], encoding)
    found = AuthorizedClients(path, {})
    assert (found.name_of(ALICE), found.name_of(BOB)) == ("Zoë Łukasz", "小林")


def test_a_broken_list_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is wrong with it is the same each time, those on the last one stay, and it heals."""
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

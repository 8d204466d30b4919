"""Texts in the user's cache: kept, and believed only where nobody else can write."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox.hub import cache


def test_a_text_is_kept_and_recalled(tmp_path: Path) -> None:
    """A folder that is open to others, a file that is no text and one that is absent are none."""
    folder = tmp_path / "texts"
    assert cache.recall(folder, "key") is None
    cache.keep(folder, "key", "é")
    assert cache.recall(folder, "key") == "é"
    folder.chmod(0o777)
    assert cache.recall(folder, "key") is None
    cache.keep(folder, "key", "again")
    assert cache.recall(folder, "key") == "again"
    (folder / "key").write_bytes(b"\xff")
    assert cache.recall(folder, "key") is None


def test_what_cannot_be_kept_is_no_error(tmp_path: Path) -> None:
    """A cache is a favour."""
    (tmp_path / "file").write_text("")
    cache.keep(tmp_path / "file", "key", "text")
    assert (tmp_path / "file").read_text() == ""


def test_a_draft_is_private_and_goes_unless_it_is_moved(tmp_path: Path) -> None:
    """Also where an interrupt ends it."""
    with pytest.raises(KeyboardInterrupt), cache.draft(tmp_path) as made:
        interrupted(made)
    assert list(tmp_path.iterdir()) == []


def interrupted(made: Path) -> None:
    """While it is filled."""
    (made / "half").write_text("")
    assert made.stat().st_mode & 0o777 == 0o700
    raise KeyboardInterrupt

"""Which names are others elsewhere; ``tests/attacks/files/test_names.py`` has what they are for."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.system.file_names import (
    ignores_case,
    taken_as_one,
    wrong_here,
    wrong_on_windows,
)
from tests.support.elsewhere.caseless import without_case


@pytest.mark.parametrize("name", ["a:b", "C:/x", "con", "CON.py", "x/nul", "lpt\u00b3", "a.", "a "])
def test_windows_reads_it_as_another(name: str) -> None:
    """Here it is a name as any other."""
    assert wrong_on_windows(name)
    assert wrong_here(name) is None


@pytest.mark.parametrize("name", ["env.py", "a b/c.d", "\u0436.txt", ".hidden", "icon", "com"])
def test_windows_reads_it_as_it_is(name: str) -> None:
    """Other scripts, dots within, and what only begins like a device."""
    assert wrong_on_windows(name) is None


@given(st.lists(st.text("aAbB/\u00e9", min_size=1, max_size=6), max_size=6, unique=True))
def test_what_is_one_without_case_is_found(paths: list[str]) -> None:
    """Whichever names there are: those that fold to the same are found, and no others."""
    paths = [path for path in paths if "" not in path.split("/")]
    prefixes = {
        "/".join(path.split("/")[:end]) for path in paths for end in range(1, path.count("/") + 2)
    }
    clash = len({prefix.casefold() for prefix in prefixes}) < len(prefixes)
    assert (taken_as_one(paths) is not None) is clash


def test_a_file_system_is_tried(tmp_path: Path) -> None:
    """With a file that is gone afterwards."""
    assert not ignores_case(tmp_path)
    with without_case(tmp_path):
        assert ignores_case(tmp_path)
    assert not list(tmp_path.iterdir())

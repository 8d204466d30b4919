"""What the tests' own plugins do: the short selection, and one line for each reason to skip."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = """
from tests.support.plugins import selection
selection.SHORT = ({start!r},)
pytest_plugins = ["tests.support.plugins.selection", "tests.support.plugins.skips"]
"""
TESTS = """
import pytest

def test_one():
    pass

def test_two():
    pass

@pytest.mark.parametrize("which", range(3))
def test_skipped(which):
    pytest.skip("needs a wind machine")

def test_imports():
    pytest.importorskip("nothing_of_this_name")
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A suite of its own, of which the short selection has one test."""
    (tmp_path / "test_it.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "conftest.py").write_text(CONFTEST.format(start="test_it.py::test_one"))
    return tmp_path


def run(folder: Path, checkout: Path, *arguments: str) -> str:
    """What pytest says in a suite that has our plugins."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments],
        cwd=folder,
        env={"PYTHONPATH": str(checkout), "TMPDIR": str(folder)},  # and not CI
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return done.stdout + done.stderr


def test_who_names_nothing_gets_the_short_selection(folder: Path, checkout: Path) -> None:
    """And is told so, and how to have all."""
    said = run(folder, checkout)
    assert "1 passed, 5 deselected" in said
    assert "--full runs every test" in said


@pytest.mark.parametrize("argument", ["--full", "test_it.py", "-kone or two or skipped or imports"])
def test_what_is_asked_for_is_run(folder: Path, checkout: Path, argument: str) -> None:
    """All of it, or a path, or an expression."""
    said = run(folder, checkout, argument)
    assert "2 passed, 4 skipped" in said
    assert "short selection" not in said


def test_a_selection_that_names_nothing_is_an_error(folder: Path, checkout: Path) -> None:
    """A test that was renamed does not fall out of it silently."""
    (folder / "conftest.py").write_text(CONFTEST.format(start="test_it.py::test_gone"))
    assert "the short selection names no test by test_it.py::test_gone" in run(folder, checkout)


def test_a_folder_that_is_ignored_is_not_missed(folder: Path, checkout: Path) -> None:
    """The rest of the selection is run."""
    (folder / "gone").mkdir()
    (folder / "conftest.py").write_text(CONFTEST.format(start="gone/test_other.py::"))
    said = run(folder, checkout, "--ignore=gone/")
    assert "names no test" not in said
    assert "6 deselected" in said


@pytest.mark.parametrize("arguments", [(), ("-n", "2")])
def test_each_reason_to_skip_is_one_line(
    folder: Path, checkout: Path, arguments: tuple[str, ...]
) -> None:
    """With the number of its tests; by however many processes they were run."""
    lines = run(folder, checkout, "--full", *arguments).splitlines()
    told = [line for line in lines if "skipped:" in line]
    assert told == [
        "3 tests skipped: needs a wind machine",
        "1 test skipped: needs nothing_of_this_name",
    ]

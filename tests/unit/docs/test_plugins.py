"""What the tests' own plugins do: the short selection, and one line for each reason to skip."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.same_for("users", "versions")

PLUGINS = 'pytest_plugins = ["tests.support.plugins.selection", "tests.support.plugins.skips"]'
TESTS = """
import pytest

@pytest.mark.short
def test_one():
    pass

@pytest.mark.short("few")
@pytest.mark.parametrize("which", ["few", "many"])
def test_two(which):
    pass

@pytest.mark.parametrize("which", range(3))
def test_skipped(which):
    pytest.skip("needs a wind machine")

def test_imports():
    pytest.importorskip("nothing_of_this_name")
"""


SKIPPED = ["3 tests skipped: needs a wind machine", "1 test skipped: needs nothing_of_this_name"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A suite of its own, of which the short selection has two tests."""
    (tmp_path / "test_it.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "conftest.py").write_text(PLUGINS)
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
    """And is told how to have all.

    A case that was renamed does not fall out of the selection silently.
    """
    said = run(folder, checkout)
    assert "2 passed, 5 deselected" in said
    assert "--full runs every test" in said
    (folder / "test_it.py").write_text(TESTS.replace('short("few")', 'short("gone", "few")'))
    said = run(folder, checkout)
    assert "the short selection names no case by 'gone' of test_it.py::test_two" in said


@pytest.mark.parametrize(
    "arguments", ["--full -n 2", "test_it.py", "-k one or two or skipped or imports"]
)
def test_what_is_asked_for_is_run(folder: Path, checkout: Path, arguments: str) -> None:
    """All of it, or a path, or an expression; by however many processes they were run.

    Each reason to skip is one line, with the number of its tests.
    """
    said = run(folder, checkout, *arguments.split(" ", 1))
    assert "3 passed, 4 skipped" in said
    assert "short selection" not in said
    assert [line for line in said.splitlines() if "skipped:" in line] == SKIPPED


def test_what_is_the_same_is_not_repeated(folder: Path, checkout: Path) -> None:
    """As another user or with other versions, each by itself."""
    marked = {"one": '"users"', "two": '"users", "versions"'}
    text = "".join(
        f"@pytest.mark.same_for({names})\ndef test_{which}():\n    pass\n"
        for which, names in marked.items()
    )
    (folder / "test_it.py").write_text(f"import pytest\ndef test_other():\n    pass\n{text}")
    for by, said in (("users", "1 passed, 2 deselected"), ("versions", "2 passed, 1 deselected")):
        assert said in run(folder, checkout, "--full", f"--differs-by={by}")
    (folder / "test_it.py").write_text("import pytest\n" + text.replace("users", "user"))
    assert "same_for names user; CI repeats for" in run(folder, checkout, "--full")

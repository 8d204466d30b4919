"""The command line takes no module out of the folder that it is called in."""

from pathlib import Path

import pytest

from tests.support.command_line import python

_MARK = "import pathlib\npathlib.Path({marker!r}).write_text('')\n"
# what the command line and its libraries import, and Python itself has not yet
_NAMES = ("click", "gymnasium", "msgpack", "numpy", "platformdirs", "rich", "typer", "zmq", "json")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A stranger's repository, that has a module of each name."""
    place = tmp_path / "repository"
    place.mkdir()
    for name in _NAMES:
        (place / f"{name}.py").write_text(_MARK.format(marker=str(tmp_path / f"{name} ran")))
    return place


def ran(folder: Path, *command: str) -> tuple[int, str, set[str]]:
    """Call it in the folder: exit code, what it said, and which of the modules were executed."""
    done = python(*command, cwd=folder, code=None)
    found = {path.name.removesuffix(" ran") for path in folder.parent.glob("* ran")}
    return done.returncode, done.stderr, found


def test_python_m_is_refused(folder: Path) -> None:
    """It names what to write instead, which works; the control executes the stranger's module."""
    code, said, found = ran(folder, "-m", "envhub_sandbox", "--version")
    assert (code, found) == (2, set())
    assert "-I -m envhub_sandbox" in said
    assert ran(folder, "-I", "-m", "envhub_sandbox", "--version")[::2] == (0, set())
    control = "from envhub_sandbox.cli import main; main()"
    assert ran(folder, "-c", control, "--version")[2]


def test_the_workers_program_is_refused_too(folder: Path) -> None:
    code, said, _ = ran(folder, "-m", "envhub_worker", "status")
    assert code == 1
    assert "-I -m envhub_worker" in said

"""``envhub init``, and no command takes a module out of the folder that it is called in."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox.extras.judge.judge import judge
from envhub_sandbox.extras.judge.settings import JudgeOptions
from envhub_sandbox.extras.starter.command import starter
from envhub_sandbox.hub.local import LocalFolder
from tests.support.command_line import COMMAND, python

PLUGIN = "envhub_sandbox.integrations.pytest_plugin"


def run(folder: Path, *command: str, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    return subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        env={**kept, **variables},
        timeout=240,
        check=False,
    )


def pytest_run(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    # by its module: what is installed beside a checkout may be of before there was a plugin
    plugins = ("no:envhub", PLUGIN, "no:cacheprovider", "no:xdist", "no:hypothesispytest")
    chosen = [part for name in plugins for part in ("-p", name)]
    return run(folder, sys.executable, "-m", "pytest", "-q", *chosen, *options)


def test_a_new_repository_passes_its_own_tests(tmp_path: Path) -> None:
    """In a sandbox; so do its further options."""
    made = run(tmp_path, *COMMAND, "init", "my-env")
    assert (made.returncode, made.stdout) == (0, "./my-env\n")
    folder = tmp_path / "my-env"
    paths = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    assert {str(path) for path in paths if path.parts[0] != ".git"} == set(starter("my-env", 2026))
    assert ((folder / ".git").is_dir()) == (shutil.which("git") is not None)
    (folder / "test_more.py").write_text(_MORE)
    lacking = pytest_run(folder, "test_more.py")
    assert lacking.returncode == 1
    assert "needs --envhub-ref REF" in lacking.stdout
    done = pytest_run(folder, "--strict-markers", "--envhub-ref", ".")
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout
    failing = pytest_run(folder, "test_more.py", "--envhub-ref", "./none")
    assert "RepositoryUnavailableError" in failing.stdout
    assert "iter_markers" not in failing.stdout  # the fixture's own source


@pytest.mark.parametrize("option", [[], ["--lerobot"]])
def test_what_it_writes_is_judged_as_it_was_asked_for(tmp_path: Path, option: list[str]) -> None:
    """With --lerobot its policies can play it; else a note of ``check`` says that they cannot."""
    made = run(tmp_path, *COMMAND, "init", "my-env", *option)
    assert made.returncode == 0, made.stderr
    asked = JudgeOptions(reference=str(tmp_path / "my-env"), arguments={"n_envs": 2}, steps=20)
    found = {one.id for one in judge(asked).findings}
    assert found == (set() if option else {"lerobot"})
    card = (tmp_path / "my-env" / "README.md").read_text()
    assert ("lerobot-eval --env.discover" in card, "$" in card) == (bool(option), False)


_MORE = """
import os, sys
import pytest

pytestmark = pytest.mark.envhub(n_envs=2, use_async_envs=True)

def test_options_of_the_module(envhub_env):
    assert envhub_env.num_envs == 2
    assert "hub_env" not in sys.modules

@pytest.mark.envhub(n_envs=3, suite="hub_env", task=0)
def test_those_of_the_test_win(tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    assert request.getfixturevalue("envhub_env").num_envs == 3
"""


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_within_a_checkout_none_is_made(tmp_path: Path) -> None:
    """Its files are a part of that one; what its tests leave behind is a part of none."""
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
    assert run(tmp_path, *COMMAND, "init", "my-env").returncode == 0
    assert not (tmp_path / "my-env/.git").exists()
    (tmp_path / "my-env/__pycache__").mkdir()
    (tmp_path / "my-env/__pycache__/env.pyc").write_text("")
    here = LocalFolder.at(tmp_path / "my-env")
    assert {one.path for one in here.files()} == set(starter("my-env", 2026))


def test_a_shell_gets_a_script_that_asks_the_program(tmp_path: Path) -> None:
    shown = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    assert "complete_bash" in run(tmp_path, *COMMAND, "--show-completion", "bash", **shown).stdout


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

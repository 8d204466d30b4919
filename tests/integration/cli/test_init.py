"""``envhub init``: what it writes passes its own check, by the plugin that it is written for."""

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
from tests.support.command_line import COMMAND

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

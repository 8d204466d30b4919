"""What an error advises is an option of the place that one is at."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.cli.app import whole_command
from envhub_sandbox.errors import EnvHubError
from tests.support.command_line import envhub
from tests.support.repositories import write_repository

pytestmark = pytest.mark.same_for("users")

_WANTS = "import nothing_of_this_name\n\ndef make_env(n_envs=1, use_async_envs=False): pass\n"
_SLOW = "import time\n\ndef make_env(n_envs=1, use_async_envs=False): time.sleep(3600)\n"
_IN_PYTHON = re.compile(r"\b(?:dependencies|policy|timeouts|limits|python|sandbox)=|Policy\(")
EXTRA = """--dependencies '{"extra": ["NAME-OF-THE-PACKAGE"]}'"""


def options_of(command: str) -> set[str]:
    return {option for one in whole_command(command).params for option in one.opts}


def said(command: str, *arguments: str | Path) -> str:
    """The error of a command, on one line; it names no option that the command does not have."""
    done = envhub(command, *arguments)
    assert done.returncode != 0
    text = " ".join(done.stderr.split())
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= options_of(command) | {"--debug"}
    return text


@pytest.mark.parametrize("command", ["run", "lock"])
def test_a_missing_module(command: str, tmp_path: Path) -> None:
    """The package joins it by an option; in Python by an argument."""
    folder = write_repository(tmp_path / "wants", _WANTS)
    own = tmp_path / "pylock.toml"
    further = ["--output", own] if command == "lock" else []
    text = said(command, folder, *further)
    assert "nothing_of_this_name" in text
    assert EXTRA in text
    assert not _IN_PYTHON.search(text)
    with pytest.raises(EnvHubError, match=r"dependencies=\{'extra': \['NAME-OF-THE-PACKAGE'\]\}"):
        make_env(folder)


def test_a_make_env_that_takes_too_long(tmp_path: Path) -> None:
    """Where a command has no such option, Python's is named as such."""
    folder = write_repository(tmp_path / "slow", _SLOW)
    text = said("run", folder, "--timeout", "1")
    assert "raise --timeout 2.0" in text
    assert not _IN_PYTHON.search(text)
    with pytest.raises(EnvHubError, match=r"raise timeouts=\{'startup_s': 2"):
        make_env(folder, timeouts={"startup_s": 1})

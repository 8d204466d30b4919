"""A hostile repository is printed by every command, and no CI system obeys anything of it."""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.cli.shared.console import guarded
from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.extras.remote import doctor as doctor_server
from envhub_sandbox.extras.remote.sandbox import ServerFacts
from tests.support.output.ci import log_of, obeyed
from tests.support.repositories import write_repository

FORGED = (
    "::error::forged",
    "::stop-commands::forged",
    "##[set-output name=a]forged",
    "##vso[task.setvariable variable=a]forged",
    "section_start:1:forged",
)
_LONG = "".join(f"{'-' * 60} {one} \n {one}\n\t{one}\r{one} " for one in FORGED)
"""Long enough to be folded, in front of each command, and with every end of a line."""
_NAME = " ".join(FORGED)
_ENV = f"""
import gymnasium as gym, numpy as np, os, sys, warnings

TEXT, NAME = {_LONG!r}, {_NAME!r}
warnings.warn(TEXT)
print(TEXT, flush=True)
Forged = type(NAME, (Exception,), {{}})

class Hostile(gym.Env):
    observation_space = gym.spaces.Dict({{NAME: gym.spaces.Box(-1, 1, (2,), np.float32)}})
    action_space = gym.spaces.Discrete(2)
    metadata = {{"render_modes": [NAME], NAME: TEXT}}
    render_mode = NAME

    def reset(self, *, seed=None, options=None):
        warnings.warn(TEXT)
        return {{NAME: np.zeros(2, np.float32)}}, {{NAME: TEXT}}

    def step(self, action):
        print(TEXT, flush=True)
        if ENDS:
            os._exit(3)
        raise Forged(TEXT)

def make_env(n_envs=1, use_async_envs=False, forged={_NAME!r}):
    if FAILS:
        raise Forged(TEXT)
    return {{NAME: {{NAME: gym.vector.SyncVectorEnv([Hostile] * n_envs)}}}}
"""


def repository(folder: Path, *, ends: bool = False, fails: bool = False) -> Path:
    text = f"ENDS, FAILS = {ends}, {fails}\n{_ENV}"
    write_repository(folder, text, README__md=f"# {_NAME}\nlicense: {_NAME}")
    for one in FORGED:
        (folder / f"{one}.py").write_text(f"import socket\nopen('~/{one}')\n")
    return folder


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder whose own name has commands in it, with hostile repositories in it."""
    place = tmp_path / _NAME
    repository(place / "raises")
    repository(place / "dies", ends=True)
    repository(place / "fails", fails=True)
    (repository(place / "refused") / f"a\n{FORGED[0]}.py").touch()
    wants = "\n".join(f"numpy; python_version < {one!r}" for one in FORGED)
    write_repository(repository(place / "wants"), _ENV, requirements__txt=wants)
    return place


def crashed(place: Path) -> Path:
    policy = {"crash_folder": str(place / "crashes")}
    with make_env(place / "dies", policy=policy) as suites:
        suites.env.reset(seed=0)
        with pytest.raises(WorkerDiedError) as died:
            suites.env.step([0])
    return Path(died.value.bundle)


def commands(place: Path) -> list[list[str]]:
    lists = place / "list.txt"
    lists.write_text("".join(f"{place / name}\n" for name in ("dies", "fails", "wants")))
    (place / "wrong.txt").write_text(f"{_NAME}\nrepo {_NAME}\n")
    raises, fails = str(place / "raises"), str(place / "fails")
    short = ["--steps", "2", "--resets", "0"]
    return [
        ["check", raises, *short, "--fail-on", "note", "--json"],
        ["check", raises, *short, "--github"],
        ["check", fails, "--debug", "--github"],
        ["check", "--all", str(lists), *short],
        ["check", "--all", str(lists), *short, "--github"],
        ["check", "--all", str(place / "wrong.txt"), "--github"],
        ["check", _NAME],
        ["check", "--allow", FORGED[0], raises],
        ["run", raises, "--episodes", "1", "--debug", "--verbose", "--worker-output", "-"],
        ["run", raises, "--suite", FORGED[0]],
        ["run", fails, "--debug"],
        ["run", str(place / "refused")],
        ["run", f"{place}\n::error::forged"],
        ["inspect", raises],
        ["inspect", "--static", str(place / "wants")],
        ["diff", raises, str(place / "wants"), "--run"],
        ["lock", raises, "--no-spaces", "--output", str(place / "lock.toml")],
        ["lock", "--check", str(place / "lock.toml"), fails, "--no-index", "--no-spaces"],
        ["inspect", "--download", str(place / "wants")],
        ["replay", str(place / "bundle")],
        ["cache", "list"],
        ["cache", "remove", FORGED[0]],
        [FORGED[0]],
        ["run", raises, f"--{FORGED[0]}"],
    ]


_NEXT = "-- the next command --"
_COMMANDS = f"""
import contextlib, json, sys
from envhub_sandbox.cli import main

for sys.argv[1:] in json.loads(sys.argv[1]):
    with contextlib.suppress(SystemExit):
        main()
    print("\\n{_NEXT}", flush=True)
"""
"""One process for all: its imports take longer than most of them."""


@pytest.mark.parametrize(("columns", "each"), [(20, 1), (None, 8)])
def test_no_command_of_a_repository_is_obeyed(columns: int | None, each: int, place: Path) -> None:
    """By what every command prints to a narrow terminal, and some into a pipe; ours are, with
    ``--github``.
    The control is the texts themselves, which all but those that cannot have them print."""
    shutil.copytree(crashed(place), place / "bundle")
    variables = {"COLUMNS": "20", "GITHUB_STEP_SUMMARY": str(place / "summary")}
    told = 0
    asked = commands(place)[::each]
    program = [sys.executable, "-I", "-W", "always", "-c", _COMMANDS, json.dumps(asked)]
    *logs, rest = log_of(program, columns, variables)[1].split(_NEXT)
    assert not rest.strip()
    for arguments, log in zip(asked, logs, strict=True):
        told += "forged" in log
        ours = [line for line in obeyed(log) if line.startswith("::")]
        assert obeyed(log) == ours, arguments
        if "--github" not in arguments:
            assert ours == [], arguments
        for line in ours:
            assert re.match(r"::(?:error|warning|notice) (?:\w+=[^,:]*,)*title=envhub check", line)
            assert line.count("::") >= 2
    assert told > len(asked) - 4


def test_the_control_is_obeyed() -> None:
    """Printed as they are, all of them are commands, also where colours or spaces are before."""
    assert len(obeyed("\n".join(FORGED))) == len(FORGED)
    assert obeyed("\x1b[31m  ::error::forged") == ["::error::forged"]
    assert len(obeyed(_LONG)) >= 3 * len(FORGED)


def test_a_server_on_another_host_is_obeyed_no_more(capsys: pytest.CaptureFixture[str]) -> None:
    """``envhub doctor`` prints what it says of itself."""
    facts = ServerFacts(
        **{
            **dict.fromkeys(ServerFacts.__dataclass_fields__, _LONG),
            "answered_s": 0.1,
            "quotas": {_LONG: 3},
            "used": {},
        }
    )
    server: Any = type("Server", (), {"endpoint": _LONG, "insecure_loopback": False})()
    with guarded():
        doctor_server.print_facts(server, facts, _LONG)
    shown = capsys.readouterr().out
    assert "forged" in shown
    assert obeyed(shown) == []


def test_json_says_what_was_found_word_for_word(place: Path) -> None:
    """What is written as an escape is the same text for a parser."""
    program = [sys.executable, "-I", "-m", "envhub_sandbox"]
    arguments = ["inspect", "--static", str(place / "raises"), "--json"]
    code, log = log_of([*program, *arguments], None)
    assert code == 0, log
    assert f"{FORGED[2]}.py" in [one["path"] for one in json.loads(log)["files"]]
    assert "##[" not in log

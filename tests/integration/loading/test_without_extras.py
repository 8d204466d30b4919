"""The core alone: an installation without extras makes environments, and says what it lacks."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.support.samples import sample
from tests.unit.docs.test_extras import extra_of
from tests.unit.docs.test_imports import modules

_ALONE = """
import importlib.abc, json, sys

missing, repository = json.loads(sys.argv.pop(1)), sys.argv[1]

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
"""
_COMMAND = "from envhub_sandbox.cli.app import app; app()"
_CALLS = """
import envhub_sandbox as hub
from envhub_sandbox import errors

with hub.make_env(repository, n_envs=2) as envs:
    env = envs.env
    env.reset(seed=1)
    print(env.step(env.action_space.sample())[1].shape)
for argument, value in json.loads(sys.argv[2]):
    try:
        hub.make_env(**{"cfg": repository, argument: value})
    except errors.SandboxUnavailableError as error:
        print(error)
"""
_ASKED = [
    ("cfg", "pypi:minigrid#MiniGrid-Empty-5x5-v0", "a reference of pypi", "hub.registered"),
    ("sandbox", "docker", "sandbox", "sandboxes.docker.sandbox"),
    ("sandbox", "tcp://localhost:1", "sandbox", "sandboxes.remote"),
    ("sandbox", ["process"], "sandbox", "sandboxes.fleet.fleet"),
    ("lock", "pylock.toml", "lock", "dependencies.source"),
    ("dependencies", {}, "dependencies", "dependencies.source"),
    ("assets", ["org/data"], "assets", "hub.sources.assets"),
]
"""An argument, a value that needs an extra, how the error calls it, and the extra's module."""


def absent() -> list[str]:
    """The client's modules of extras, without the folders that modules of the core lie in."""
    core = {name for name in modules() if extra_of(name) is None}
    parents = {name[:end] for name in core for end in range(len(name)) if name[end] == "."}
    extras = modules().keys() - core - parents
    return sorted(name for name in extras if name.startswith("envhub_sandbox."))


def alone(program: str, *arguments: str, code: int = 0) -> str:
    """What a program prints where no extra can be imported."""
    command = [sys.executable, "-c", _ALONE + program, json.dumps(absent()), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


def test_the_core_needs_no_extra() -> None:
    """It makes an environment; what a caller asks for beyond that is named."""
    asked = json.dumps([(argument, value) for argument, value, _, _ in _ASKED])
    shape, *refused = alone(_CALLS, sample("cartpole"), asked).splitlines()[-1 - len(_ASKED) :]
    assert shape == "(2,)"
    assert [line.partition(", which this")[0] for line in refused] == [
        f"{what} needs envhub_sandbox.{module}" for _, _, what, module in _ASKED
    ]


def test_a_command_of_an_extra_is_named() -> None:
    """Those of the core run."""
    assert "steps/s" in alone(_COMMAND, "run", "examples:cartpole", "--episodes", "1")
    for words in (["check", "x"], ["inspect", "x", "--static"], ["doctor", "tcp://a:1"]):
        assert "which this installation of envhub-sandbox lacks" in alone(
            _COMMAND, *words, code=2 if words[0] == "check" else 6
        )

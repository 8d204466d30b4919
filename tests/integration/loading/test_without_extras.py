"""The core alone: an installation without extras makes environments, and says what it lacks."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.support.samples import sample
from tests.unit.docs.test_extras import CORE_IMPORTS_EXTRAS, extra_of
from tests.unit.docs.test_imports import imported, modules

_PROGRAM = """
import importlib.abc, json, sys

missing, repository = json.loads(sys.argv[1]), sys.argv[2]

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import envhub_sandbox as hub
from envhub_sandbox import errors

with hub.make_env(repository, n_envs=2) as envs:
    env = envs.env
    env.reset(seed=1)
    print(env.step(env.action_space.sample())[1].shape)
for argument, value in json.loads(sys.argv[3]):
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
    """The client's modules of extras, but for what the core below its commands still imports."""
    todo = {
        f"{importer.partition('.')[0]}.{name}"
        for importer, names in CORE_IMPORTS_EXTRAS.items()
        for name in names
        if not importer.startswith("envhub_sandbox.cli.")
    }
    present = set[str]()
    while todo:
        name = todo.pop()
        present.add(name)
        parent = name.rpartition(".")[0]
        todo |= {one for one in (parent, *imported(name)) if one in modules()} - present
    extras = {name for name in modules() if extra_of(name) is not None}
    return sorted(name for name in extras - present if name.startswith("envhub_sandbox."))


def test_the_core_needs_no_extra(tmp_path: Path) -> None:
    """It runs an environment; what a caller asks for beyond that is named."""
    asked = [(argument, value) for argument, value, _, _ in _ASKED]
    arguments = json.dumps(absent()), sample("cartpole"), json.dumps(asked)
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *arguments],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    shape, *refused = done.stdout.splitlines()
    assert shape == "(2,)"
    assert [line.partition(", which this")[0] for line in refused] == [
        f"{what} needs envhub_sandbox.{module}" for _, _, what, module in _ASKED
    ]

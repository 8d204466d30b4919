"""The core alone: an installation without extras makes environments, and says what it lacks."""

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.samples import sample
from tests.unit.docs.test_distributions import built
from tests.unit.docs.test_extras import EXTRAS
from tests.unit.docs.test_imports import folder

_COMMAND = "from envhub_sandbox.cli.app import app; app()"
_CALLS = """
import json, sys
import envhub_sandbox as hub
from envhub_sandbox import errors

repository, asked = sys.argv[1], json.loads(sys.argv[2])
for lane in ("auto", "frames"):
    with hub.make_env(repository, n_envs=2, policy={"lane": lane}) as envs:
        env = envs.env
        env.reset(seed=1)
        print(env.step(env.action_space.sample())[1].shape)
for argument, value in asked:
    try:
        hub.make_env(**{"cfg": repository, "n_envs": 2, argument: value})
    except errors.SandboxUnavailableError as error:
        print(str(error).splitlines()[0])
"""
_FOLDER = sample("cartpole")
_ASKED = [
    ("cfg", "pypi:minigrid#MiniGrid-Empty-5x5-v0", "a reference of pypi", "sources.registered"),
    ("cfg", f"{_FOLDER}/env.py", f"local file {_FOLDER}/env.py", "sources.own"),
    ("sandbox", "docker", "sandbox", "docker.sandbox"),
    ("sandbox", "tcp://localhost:1", "sandbox", "remote.sandbox"),
    ("sandbox", ["process"], "sandbox", "fleet.fleet"),
    ("lock", "pylock.toml", "lock", "packages.source"),
    ("dependencies", {}, "dependencies", "packages.source"),
    ("assets", ["org/data"], "assets", "sources.assets"),
    ("policy", {"restart": "transparent"}, "policy={'restart': 'transparent'}", "restart.recovery"),
    ("min_ready", 1, "several workers with jails", "several_workers.fleet_session"),
]
"""An argument, a value that needs an extra, how the error calls it, and the extra's module."""
_OF_WORKER = [("denials", {"record_denials": True}), ("display", {"display": "virtual"})]
"""An extra of the worker, and a policy that needs it."""


@pytest.fixture(scope="module")
def core(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what a wheel holds that is built of what is installed, without the extras."""
    root = tmp_path_factory.mktemp("core")
    source, installed = root / "source", root / "installed"
    ignored = shutil.ignore_patterns("__pycache__", *(name.split(".")[1] for name in EXTRAS))
    for package, copy in (("envhub_sandbox", ""), ("envhub_worker", "worker/")):
        shutil.copytree(folder(package), source / f"{copy}{package}", ignore=ignored)
    shutil.copytree(checkout / "examples", source / "examples")
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(checkout / file, source)
    with zipfile.ZipFile(built("wheel", source, root / "wheel")) as wheel:
        assert not {"extras", "integrations"} & {Path(one).parent.name for one in wheel.namelist()}
        wheel.extractall(installed)
    return installed


def alone(core: Path, program: str, *arguments: str, code: int = 0) -> str:
    """What a program prints that has the core alone."""
    # without what an editable installation adds, which has the extras
    begin = (
        f"import sys; sys.path.insert(0, {str(core)!r}); sys.meta_path[:] = [finder for finder in "
        "sys.meta_path if 'editable' not in getattr(finder, '__module__', '')]\n"
    )
    command = [sys.executable, "-c", begin + program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_the_core_needs_no_extra(core: Path) -> None:
    """It makes an environment; what a caller asks for beyond that is named."""
    asked = [(argument, value) for argument, value, _, _ in _ASKED]
    asked += [("policy", policy) for _, policy in _OF_WORKER]
    printed = alone(core, _CALLS, sample("cartpole"), json.dumps(asked)).splitlines()
    *shapes, refused = *printed[-len(asked) - 2 : -len(asked)], printed[-len(asked) :]
    assert shapes == ["(2,)", "(2,)"]
    assert [line.partition(", which this")[0] for line in refused[: len(_ASKED)]] == [
        f"{what} needs envhub_sandbox.extras.{module}" for _, _, what, module in _ASKED
    ]
    for line, (name, _) in zip(refused[len(_ASKED) :], _OF_WORKER, strict=True):
        assert f"installed without envhub_worker.extras.{name}" in line


def test_the_commands_of_the_core_run(core: Path, checkout: Path) -> None:
    """Those of extras are named."""
    example = str(checkout / "examples" / "cartpole")
    assert "steps/s" in alone(core, _COMMAND, "run", example, "--n-envs", "4", "--episodes", "4")
    for code, *words in ((2, "check", "x"), (6, "inspect", "x", "--static"), (6, "doctor", "tcp:")):
        said = alone(core, _COMMAND, *words, code=code)
        assert "which this installation of envhub-sandbox lacks" in said.replace("\n", " ")

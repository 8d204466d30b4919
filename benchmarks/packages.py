"""Repositories around real packages, from nothing but what they declare: what comes up, how soon.

``python -m benchmarks.packages [NAME ...]`` prints a table. Each gets caches of its own, so that a
cold run downloads everything; it needs an index.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

_LONG_S = 1800.0
_ALWAYS = ("--dependencies", "{}")
"""An environment of its own, although this interpreter may have all of it."""
_ENV = """\
import os
os.environ.setdefault("MUJOCO_GL", "{gl}")
import gymnasium as gym
{imports}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: gym.make({make})] * n_envs)
"""


@dataclass(frozen=True)
class Case:
    """A repository.

    Attributes:
        requirements: Lines of its ``requirements.txt``.
        imports: What registers its environment.
        make: The arguments of ``gymnasium.make``.
        gl: MuJoCo's way to render.
    """

    requirements: str
    imports: str
    make: str
    gl: str = "disable"

    def write(self, folder: Path) -> None:
        """Its files."""
        folder.mkdir()
        (folder / "requirements.txt").write_text(self.requirements + "\n")
        code = _ENV.format(imports=self.imports, make=self.make, gl=self.gl)
        (folder / "env.py").write_text(code)


CASES: Mapping[str, Case] = {
    "minigrid": Case("minigrid>=3", "import minigrid", '"MiniGrid-Empty-5x5-v0"'),
    "highway-env": Case("highway-env", "import highway_env", '"highway-v0"'),
    "ale-py": Case("ale-py", "import ale_py", '"ALE/Pong-v5"'),
    "panda-gym": Case("panda-gym", "import panda_gym", '"PandaReach-v3"'),
    "gym-pusht": Case("gym-pusht\npymunk<7", "import gym_pusht", '"gym_pusht/PushT-v0"'),
    "dm_control": Case(
        "shimmy[dm-control]\nmujoco<4\npackaging",  # which one of them imports, and none declares
        "import shimmy\ngym.register_envs(shimmy)",
        '"dm_control/cartpole-balance-v0"',
    ),
    "gym-aloha": Case(
        "gym-aloha", "import gym_aloha", '"gym_aloha/AlohaInsertion-v0", obs_type="pixels"', "egl"
    ),
    "gym-xarm": Case("gym-xarm", "import gym_xarm", '"gym_xarm/XarmLift-v0", obs_type="state"'),
    "pybullet": Case("gym-pybullet-drones", "import gym_pybullet_drones", '"hover-aviary-v0"'),
    "metaworld": Case(
        "metaworld\npackaging", "import metaworld", '"Meta-World/MT1", env_name="reach-v3"'
    ),
}


@dataclass(frozen=True)
class Came:
    """What became of one.

    Attributes:
        seconds: Of the runs cold, warm and offline, as far as it came.
        bytes: Of its environment.
        packages: Their number.
        error: Why it went no further; empty if it did.
    """

    seconds: tuple[float, ...]
    bytes: int
    packages: int
    error: str


def measured(case: Case, folder: Path) -> Came:
    """Bring a case up three times: cold, warm, and without network or remembered description."""
    case.write(folder / "repo")
    variables = {
        **os.environ,
        "CI": "1",
        "ENVHUB_CACHE": str(folder / "cache"),
        "UV_CACHE_DIR": str(folder / "uv"),
    }
    nowhere = dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), "http://127.0.0.1:9")
    seconds: list[float] = []
    error = ""
    for more in ({}, {}, {**nowhere, "UV_OFFLINE": "1"}):
        if more:
            shutil.rmtree(folder / "cache/manifests", ignore_errors=True)
        start = perf_counter()
        error = _played(folder / "repo", {**variables, **more})
        if error:
            break
        seconds.append(perf_counter() - start)
    made = _environments(variables)
    size, packages = (made["bytes"], len(made["packages"])) if made else (0, 0)
    return Came(tuple(seconds), size, packages, error)


def _played(repository: Path, variables: Mapping[str, str]) -> str:
    """Play some steps; the first line of the error, or nothing."""
    done = _envhub(
        ["run", str(repository), *_ALWAYS, "--episodes", "1", "--steps", "20", "--json"],
        variables,
    )
    try:
        error = json.loads(done.stdout)["error"]
    except (ValueError, LookupError):
        return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    return "" if error is None else _reason(error["message"])


def _reason(message: str) -> str:
    """The line that says it, without where it came from."""
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    causes = [line for line in lines if line.startswith(("cause:", "hint:", "Because"))]
    text = (causes or lines)[0].removeprefix("cause: ")
    return text.partition("env.py: ")[2][:300] or text[:300]


def _environments(variables: Mapping[str, str]) -> dict[str, Any] | None:
    made = json.loads(_envhub(["cache", "list", "--json"], variables).stdout)["environments"]
    return made[0] if made else None


def _envhub(words: Sequence[str], variables: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-I", "-m", "envhub_sandbox", *words]
    return subprocess.run(
        command, capture_output=True, text=True, env=dict(variables), timeout=_LONG_S
    )


def row(name: str, came: Came) -> str:
    """A line of the table."""
    times = [f"{one:.1f}" for one in came.seconds] + [""] * (3 - len(came.seconds))
    size = f"{came.bytes / 2**20:,.0f}" if came.bytes else ""
    cells = [name, *times, size, str(came.packages or ""), came.error.replace("|", "\\|")]
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| repository around | cold, s | warm, s | offline, s | MiB | packages | what failed |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; the exit code says whether all came up."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.packages", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(CASES)}")
    names = parser.parse_args(arguments).names or list(CASES)
    if unknown := [name for name in names if name not in CASES]:
        parser.error(f"there is no {', '.join(unknown)}; there are {', '.join(CASES)}")
    print(HEAD, flush=True)
    failed = 0
    for name in names:
        with tempfile.TemporaryDirectory(prefix="envhub-packages-") as folder:
            Path(folder).chmod(0o755)  # a jail of root is another user
            came = measured(CASES[name], Path(folder))
            _open_again(Path(folder))
        print(row(name, came), flush=True)
        failed += bool(came.error)
    return 1 if failed else 0


def _open_again(folder: Path) -> None:
    """What is read-only could not be removed by a plain user."""
    for above, _, _ in os.walk(folder):
        os.chmod(above, 0o755)


if __name__ == "__main__":
    raise SystemExit(main())

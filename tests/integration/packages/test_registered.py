"""``pypi:NAME@VERSION#ID``: an environment that a package registers, without a repository."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import LoadError, WorkerDiedError
from envhub_sandbox.extras.crash.bundle_reader import load_bundle
from tests.support.command_line import document, envhub
from tests.support.compare import assert_same, rolled
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, make_wheel

REGISTERS = """
import gymnasium
gymnasium.register("Walled/Maze-v{version}", "{module}:Maze", max_episode_steps=7)
gymnasium.register("Walled/Other-v0", "{module}:Maze")
"""
MAZE = """
import os

import gymnasium
import numpy as np


class Maze(gymnasium.Env):
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 5}

    def __init__(self, size=3, render_mode=None):
        self.size, self.render_mode, self.dies = size, render_mode, False
        self.observation_space = gymnasium.spaces.Box(0, 1, (size,))
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.random(self.size, dtype=np.float32), {}

    def step(self, action):
        if self.dies:
            os._exit(3)
        return self.np_random.random(self.size, dtype=np.float32), float(action), False, False, {}

    def render(self):
        return np.full((4, 4, 3), self.size, np.uint8)
"""


@pytest.fixture(scope="module")
def packages(real_index: Index) -> Index:
    """Packages that register in each way that there is; none of them is installed here."""
    folder = real_index.folder
    for version in ("1.0", "2.0"):
        named = REGISTERS.format(version=version[0], module="walled.maze")
        files = {"walled/__init__.py": named, "walled/maze.py": MAZE}
        make_wheel(folder, "walled", version, files=files, requires=["gymnasium"])
    inner = REGISTERS.format(version=1, module="inner.envs")
    make_wheel(
        folder,
        "inner-registers",
        files={"inner/__init__.py": "", "inner/envs.py": MAZE + inner, "tests.py": "1 / 0"},
    )
    function = f"def register_all():{inner}".replace("\n", "\n    ").replace("inner", "plugin")
    make_wheel(
        folder,
        "plugged-in",
        files={
            "plugin/__init__.py": "",
            "plugin/envs.py": MAZE,
            "plugin/later.py": function,
            "plugged_in-1.0.dist-info/entry_points.txt": (
                "[gymnasium.envs]\n__root__ = plugin.later:register_all\n"
            ),
        },
    )
    asked = "from gymnasium import register\n" + function.replace("_all", "_envs")
    asked = asked.replace("plugin", "asked")
    make_wheel(folder, "asked", files={"asked/__init__.py": asked, "asked/envs.py": MAZE})
    optional = (
        "try:\n    import gym\nexcept ImportError:\n    pass\nelse:\n    gym.register('A-v0')\n"
    )
    none = {"no_envs.py": "from gymnasium import register", "tests/test_them.py": optional}
    make_wheel(folder, "no-envs", files=none)
    make_wheel(folder, "needs-gym", files={"needs_gym.py": optional})
    return real_index


@pytest.fixture(scope="module")
def here() -> dict[str, Any]:
    namespace: dict[str, Any] = {}
    exec(MAZE, namespace)
    return namespace


def test_it_is_what_gymnasium_makes(packages: Index, here: dict[str, Any]) -> None:
    kwargs = {"size": 5}
    with make_env("pypi:walled@1.0#Walled/Maze-v1", 3, True, env_kwargs=kwargs) as suites:
        found = rolled(suites.env)
        assert suites.env.num_envs == 3
        installed, provenance = suites.provenance["installed"], suites.provenance
    gymnasium.register("Maze-v1", lambda **given: here["Maze"](**given), max_episode_steps=7)
    try:
        makes = [lambda: gymnasium.make("Maze-v1", size=5)] * 3
        assert_same(rolled(gymnasium.vector.SyncVectorEnv(makes)), found)
    finally:
        gymnasium.registry.pop("Maze-v1")
    assert "walled==1.0" in installed["packages"]
    assert (provenance["repository"], provenance["repo_type"]) == (
        "walled@1.0#Walled/Maze-v1",
        "pypi",
    )


def test_it_gives_pictures_unasked(packages: Index) -> None:
    """Where its class says so; and what the caller says holds. Without a version the index chooses,
    and says which it was."""
    with make_env("pypi:walled#Walled/Other-v0") as suites:
        assert "walled==2.0" in suites.provenance["installed"]["packages"]
        assert suites.reference == "pypi:walled#Walled/Other-v0"
        suites.env.reset(seed=0)
        [picture] = suites.env.call("render")
        assert picture.tolist() == [[[3] * 3] * 4] * 4
    with make_env("pypi:walled#Walled/Other-v0", env_kwargs={"render_mode": None}) as suites:
        assert suites.env.render_mode is None


@pytest.mark.parametrize(
    "begins", ["inner-registers#", "plugged-in#", "asked#", "inner-registers#inner.envs:"]
)
def test_what_registers_it_is_found(packages: Index, begins: str) -> None:
    """A module further inside, also by its name; and a function of the entry point for that, or
    one that users call.
    """
    with make_env(f"pypi:{begins}Walled/Maze-v1") as suites:
        suites.env.reset(seed=0)


def test_an_id_that_is_not_there(packages: Index) -> None:
    with pytest.raises(LoadError, match=r"walled 2\.0 registers no environment") as caught:
        make_env("pypi:walled#Walled/Mase-v2")
    assert "but 2 others. Near ones are Walled/Maze-v2" in str(caught.value)
    assert "CartPole" not in str(caught.value)
    with pytest.raises(
        LoadError, match=r"no-envs 1\.0 registers no environment with Gymnasium(?!, but)"
    ):
        make_env("pypi:no-envs#Walled/Maze-v2")
    with pytest.raises(LoadError, match=r"but with gym,(?s:.*)\{'extra': \['gym'\]\}"):
        make_env("pypi:needs-gym#A-v0")
    with pytest.raises(LoadError, match=r"gymnasium [\d.]+ registers no environment") as caught:
        make_env("pypi:gymnasium#CartPole-v9")  # whose ids are there from the start
    assert "CartPole-v1" in str(caught.value)


def test_a_package_or_version_that_is_not_there(packages: Index) -> None:
    with refused_dependency("resolution", match=r"(?s)walled==9\.9.*has the index that version"):
        make_env("pypi:walled@9.9#Walled/Maze-v2")


def test_commands_know_it(packages: Index, tmp_path: Path) -> None:
    ref, newer = "pypi:walled@1.0#Walled/Other-v0", "pypi:walled#Walled/Other-v0"
    lock = str(tmp_path / "pylock.x.toml")
    locked = document("lock", ref, "-o", lock)
    assert locked["reference"] == ref
    assert "walled==1.0" in locked["packages"]
    assert document("lock", "--check", lock)["drift"] == []
    assert document("lock", "--check", lock, newer, "--no-spaces", code=7)["drift"]
    assert "walled" in json.dumps(document("diff", ref, newer, code=7))
    assert document("inspect", ref)["provenance"]["repo_type"] == "pypi"
    played = document("run", ref, "--episodes", "1", "--steps", "5")
    assert played["provenance"]["repository"] == ref.removeprefix("pypi:")
    judged = envhub("check", newer, "--steps", "20")
    said = " ".join((judged.stdout + judged.stderr).split())
    assert "another commit or version tomorrow" in said
    assert "licence" not in said
    listed = [one["repository"] for one in document("cache", "list")["snapshots"]]
    assert {ref, newer} <= set(listed)


def test_a_crash_bundle_has_it(packages: Index, tmp_path: Path) -> None:
    ref, policy = "pypi:walled@1.0#Walled/Other-v0", {"crash_folder": str(tmp_path)}
    with make_env(ref, policy={**policy, "restart": "never"}) as suites:
        suites.env.reset(seed=0)
        suites.env.set_attr("dies", True)
        with pytest.raises(WorkerDiedError):
            suites.env.step(suites.env.action_space.sample())
    [folder] = [path.parent for path in tmp_path.rglob("bundle.json")]
    assert load_bundle(folder).reference == ref
    envhub("replay", "--grant", str(folder), code=0)

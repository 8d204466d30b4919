"""Where the sample repositories are, and how to run one in this process as the reference.
Importing them here is allowed: they are ours. The environments that come out are what an
in-process user of Gymnasium would have, and so the oracle for the sandbox."""

import importlib
import importlib.util
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

SAMPLES = Path(__file__).resolve().parent.parent / "samples"
EXAMPLES = SAMPLES.parent.parent / "examples"

# what a requirement of a sample is called when it is imported, where that is another name
_MODULES = {"gymnasium[box2d]": "Box2D", "gymnasium[mujoco]": "mujoco"}


def sample(name: str) -> Path:
    """The folder of a sample repository; the test is skipped if what it requires is missing."""
    folder = SAMPLES / name
    if not folder.is_dir():
        raise FileNotFoundError(f"no sample repository named {name!r}")
    requirements = folder / "requirements.txt"
    for required in requirements.read_text().split() if requirements.exists() else ():
        module = _MODULES.get(required, required.replace("-", "_"))
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"needs {required}")
    return folder


def make_env_of(folder: Path) -> Callable[..., Any]:
    """``make_env`` of a repository's ``env.py``, imported into this process."""
    package = f"reference_{folder.parent.name}_{folder.name}"
    if package not in sys.modules:
        module = types.ModuleType(package)
        module.__path__ = [str(folder)]
        sys.modules[package] = module
    with pytest.MonkeyPatch.context() as patch:  # a repository in which bytecode lies is refused
        patch.setattr(sys, "dont_write_bytecode", True)
        entry = importlib.import_module(f"{package}.env")
    return entry.make_env


def reference(name: str, n_envs: int = 1, **env_kwargs: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
    """The vector environment that a sample builds in this process, with ``SyncVectorEnv``."""
    made = make_env_of(sample(name))(n_envs=n_envs, use_async_envs=False, **env_kwargs)
    if not isinstance(made, gym.vector.VectorEnv):
        raise TypeError(f"{name} gives a {type(made).__name__}, which is no single reference")
    return made


class Frozen(gym.Wrapper[Any, Any, Any, Any]):
    """What LeRobot does in its rollouts: the last transition once more, without its reward."""

    over: Any = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """The last observation, unless a rollout begins."""
        if self.over and not (options or {}).get("lerobot_new_rollout"):
            return self.over[0], self.over[4]
        self.over = None
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """The last transition, if there is one."""
        if self.over:
            return self.over
        result = self.env.step(action)
        if result[2] or result[3]:
            self.over = (result[0], 0.0, *result[2:])
        return result

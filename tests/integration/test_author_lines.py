"""What an environment raises leads to the line that raised it, in a real jail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from tests.hub.stub_hub import StubHub
from tests.support.repositories import write_repository

ENV = """
import gymnasium as gym
from parts.motor import turn

class Motor(gym.Env):
    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return turn(action), 0.0, False, False, {}

def make_env(n_envs=1, use_async_envs=False, broken=False):
    if broken:
        turn(0)
    return gym.vector.SyncVectorEnv([Motor] * n_envs)
"""
MOTOR = "def turn(angle):\n    raise ZeroDivisionError('stuck')\n"


def failure(reference: str, *, at: str, **options: Any) -> EnvHubError:
    """What is raised in loading or in a step."""
    broken = {"broken": True} if at == "make_env" else None
    with pytest.raises(ZeroDivisionError, match="stuck") as caught:
        play(reference, env_kwargs=broken, **options)
    assert isinstance(caught.value, EnvHubError)
    return caught.value


def play(reference: str, **options: Any) -> None:
    """One step."""
    with make_env(reference, **options) as suites:
        suites.env.reset(seed=0)
        suites.env.step([0])


@pytest.mark.parametrize(
    ("at", "lane"), [("step", "auto"), ("step", "frames"), ("make_env", "auto")]
)
def test_the_line_in_the_authors_own_folder(tmp_path: Path, at: str, lane: str) -> None:
    """And not the one in the copy that was run."""
    folder = Path(write_repository(tmp_path / "mine", ENV))
    (folder / "parts").mkdir()
    (folder / "parts" / "motor.py").write_text(MOTOR)
    error = failure(str(folder), at=at, lane=lane)
    where = f'  File "{folder}/parts/motor.py", line 2, in turn\n'
    assert str(error).endswith(f"{where}    raise ZeroDivisionError('stuck')")
    [note] = vars(error)["__notes__"]
    place, line = ("make_env", 17) if at == "make_env" else ("step", 13)
    assert f'File "{folder}/env.py", line {line}, in {place}\n' in note
    assert note.count("File ") == 2, note


def test_the_line_in_a_repository_of_the_hub(stub_hub: StubHub, hub_cache: Path) -> None:
    """Its name there, and the commit."""
    made = stub_hub.add("org/motor", {"env.py": ENV, "parts/motor.py": MOTOR})
    options = {"endpoint": stub_hub.endpoint, "hub_cache_dir": hub_cache}
    error = failure("org/motor", at="step", **options)
    place = f'"parts/motor.py" of org/motor@{made.commit[:12]}, line 2, in turn'
    assert f"File {place}\n" in str(error)
    assert str(hub_cache) not in str(error) + vars(error)["__notes__"][0]

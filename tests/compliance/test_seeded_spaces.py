"""Seeded spaces draw the same here and there; what nobody seeded starts anywhere, in each run."""

import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox import SandboxEnv, make_env
from envhub_sandbox.errors import RemoteEnvWarning
from tests.support.compare import assert_same

REPOSITORY = """
import gymnasium as gym
import numpy as np
from gymnasium import spaces

MADE = {
    "discrete": lambda seed: spaces.Discrete(1000, seed=seed),
    "box": lambda seed: spaces.Box(-1, 1, (2,), seed=seed),
    "box twice": lambda seed: spaces.Tuple([spaces.Box(-1, 1, (2,))] * 2, seed=seed),
    "boxes": lambda seed: spaces.Tuple([spaces.Box(-1, 1), spaces.Box(-1, 1)], seed=seed),
    "dict": lambda seed: spaces.Dict({"a": spaces.Discrete(50), "b": spaces.Box(0, 1)}, seed=seed),
    "text": lambda seed: spaces.Text(30, seed=seed),
    "sequence": lambda seed: spaces.Sequence(spaces.Discrete(90), seed=seed),
    "graph": lambda seed: spaces.Graph(spaces.Box(0, 1), spaces.Discrete(90), seed=seed),
    "one of": lambda seed: spaces.OneOf([spaces.Discrete(90), spaces.Box(0, 1)], seed=seed),
    "mt19937": lambda seed: spaces.Discrete(
        1000, seed=np.random.Generator(np.random.MT19937(seed))
    ),
}

class Seeded(gym.Env):
    def __init__(self, kind, seed, draws):
        self.draws = draws
        self.action_space = MADE[kind](seed)
        self.observation_space = MADE[kind](seed and seed + 1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        if self.draws:
            self.action_space.sample()
        return self.observation_space.sample(), 0.0, False, False, {}

class Own(gym.vector.SyncVectorEnv):
    pass

def make_env(n_envs=1, use_async_envs=False, kind="discrete", seed=None, own=False, draws=False):
    made = Own if own else gym.vector.SyncVectorEnv
    return made([lambda: Seeded(kind, seed, draws)] * n_envs)
"""
LOCAL: dict[str, Any] = {}
exec(REPOSITORY, LOCAL)
SPACES = ("single_action_space", "action_space", "single_observation_space", "observation_space")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "env.py").write_text(REPOSITORY)
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "own"), [*((kind, False) for kind in LOCAL["MADE"]), ("dict", True), ("graph", True)]
)
def test_samples_are_those_of_the_plain_environment(folder: Path, kind: str, own: bool) -> None:
    """Of each of the four spaces; also when the manifest is remembered, and no process runs."""
    for _ in range(2):
        reference = LOCAL["make_env"](3, kind=kind, seed=5)
        env = make_env(folder, n_envs=3, env_kwargs={"kind": kind, "seed": 5, "own": own}).env
        for name in SPACES:
            for _ in range(3):
                assert_same(getattr(reference, name).sample(), getattr(env, name).sample(), name)
        env.close()


@pytest.mark.parametrize("kind", ["box twice", "dict", "sequence", "graph", "one of"])
def test_what_nobody_seeded_starts_anywhere(folder: Path, kind: str) -> None:
    """A remembered manifest does not make every run begin at the same place."""
    drawn = []
    for _ in range(2):
        env = make_env(folder, n_envs=3, env_kwargs={"kind": kind}).env
        drawn.append(repr([[getattr(env, name).sample() for _ in range(9)] for name in SPACES]))
        env.close()
    assert len(set(drawn)) == 2


def test_a_space_that_is_asked_for_draws_the_same(folder: Path) -> None:
    env = make_env(folder, n_envs=2, num_workers=1, env_kwargs={"seed": 5}).env
    reference = LOCAL["make_env"](2, seed=5)
    for expected, found in zip(
        reference.get_attr("observation_space"), env.get_attr("observation_space"), strict=True
    ):
        assert isinstance(found, spaces.Discrete)
        assert [found.sample() for _ in range(5)] == [expected.sample() for _ in range(5)]
    for one in (env, reference):
        one.action_space.seed(9)
    assert_same(reference.action_space.sample(), env.action_space.sample(), "the caller's seed")
    env.close()


def test_boxes_that_are_alike_do_not_share_a_generator(folder: Path) -> None:
    """They share their bounds; one of two that are seeded alike is not drawn from by the other."""
    env = make_env(folder, env_kwargs={"kind": "boxes", "seed": 5}).env
    first, second = env.single_action_space.spaces
    assert first.np_random is not second.np_random
    assert not np.array_equal(first.sample(), second.sample())
    env.close()


@pytest.mark.parametrize("draws", [False, True])
def test_a_single_environment_that_draws_from_its_action_space_says_so(
    folder: Path, draws: bool
) -> None:
    """There it is one object with the caller's, and here the caller's is a copy."""
    with (
        closing(SandboxEnv(folder, env_kwargs={"seed": 3, "draws": draws})) as env,
        warnings.catch_warnings(record=True) as told,
    ):
        warnings.simplefilter("always")
        for _ in range(3):
            env.reset()
            env.step(env.action_space.sample())
    assert [type(each.message) for each in told] == [RemoteEnvWarning] * draws

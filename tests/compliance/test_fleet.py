"""Sub-environments over several workers, each in a jail of its own: what one place gives."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from tests.compliance.pair import Pair
from tests.compliance.vector_env import MODES, Case, VectorEnvCompliance, paired
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.repositories import write_repository

# what the first sub-environment that has a key gives decides its dtype: of whichever worker that is
_UNLIKE = """
import gymnasium as gym
import numpy as np

class Unlike(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(9)

    def __init__(self, index):
        self.index = index

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.float32(self.np_random.normal(size=1)), self.told()

    def step(self, action):
        self.count += 1
        return np.float32([self.index]), 1.0, False, False, self.told()

    def told(self):
        value = [self.index, "text", 0.5, np.arange(2)][(self.index // 2 + self.count) % 4]
        mixed = {"mixed": value} if self.count and self.count % 3 != self.index % 2 else {}
        own = {f"own{self.index}": self.index, "deep": {"both": float(self.index)}}
        return {**mixed, **own, "final_obs": np.float32([self.index])}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda i=i: Unlike(i) for i in range(n_envs)])
"""


def _spread(n_envs: int, workers: int, modes: tuple[str, ...] = MODES) -> list[Case]:
    return [Case(n_envs, False, {"autoreset_mode": mode}, workers) for mode in modes]


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, lane: str) -> Iterator[Pair]:
    """The reference, and an environment of which each worker is on a place of its own."""
    options = {"sandbox": ["process"] * (case.num_workers or 1), "policy": {"lane": lane}}
    with paired(request.cls.sample, case, **options) as both:
        yield both


class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos, episodes of two to six steps; five rows, three workers."""

    sample = "counter"
    cases = _spread(5, 3)
    steps = 80

    def test_it_is_spread_as_evenly_as_it_goes(self, pair: Pair) -> None:
        """Each worker has its slice, and a process of its own."""
        pair.reset(seed=1)
        workers = pair.sandboxed.sandbox.stats()["workers"]
        assert [worker["rows"] for worker in workers] == [[0, 2], [2, 4], [4, 5]]
        jails = [part.lease.loaded.jail.number for part in inside.parts(pair.sandboxed)]
        assert len(set(jails)) == 3

    def test_one_of_them_by_itself(self, pair: Pair) -> None:
        """``env.envs[i]`` is the one of that place, in whichever worker it is, with the value that
        is its own. What one worker's code raises is raised; the environment goes on."""
        for env in (pair.reference, pair.sandboxed):
            env.set_attr("gain", [0.5 + i for i in range(pair.num_envs)])
        pair.reset(seed=6)
        for index in range(pair.num_envs):
            action = pair.reference.single_action_space.sample()
            expected = pair.reference.envs[index].step(action)
            got = pair.sandboxed.envs[index].step(action)
            assert np.array_equal(expected[0], got[0])
            assert expected[1:4] == got[1:4]
        for env in (pair.reference, pair.sandboxed):
            env.set_attr("gain", 1.0)
        with pytest.raises(ValueError, match="counter 0 failed"):
            pair.sandboxed.call("fail")
        pair.drive(seed=5, steps=10)


class TestExoticSpaces(VectorEnvCompliance):
    """Spaces that have no fixed layout."""

    sample = "exotic_spaces"
    cases = _spread(3, 2, ("SameStep",))
    steps = 40


class TestLeRobotPendulum(VectorEnvCompliance):
    """Dict observations and ``is_success`` in every info; as many workers as rows."""

    sample = "lerobot_pendulum"
    cases = _spread(3, 3, ("NextStep",))
    steps = 60


class TestCartPole(VectorEnvCompliance):
    """More workers wanted than there are rows."""

    sample = "cartpole"
    cases = _spread(2, 4, ("SameStep",))
    steps = 300


def test_infos_that_do_not_fit_together(tmp_path: Path, lane: str) -> None:
    """Where workers' infos are no parts of one mapping, they are joined one by one, as Gymnasium
    does it; or raise, as it does. (Its rows after the one that raised are not stepped then.)"""
    repository = write_repository(tmp_path, _UNLIKE)
    here: dict[str, Any] = {}
    exec(_UNLIKE, here)
    for spread in ([0, 1], [0, 1, 2, 3, 4, 5]):
        expected = here["make_env"](n_envs=6)
        with make_env(
            repository, n_envs=6, sandbox=["process"] * len(spread), policy={"lane": lane}
        ) as suites:
            assert_same(expected.reset(seed=4), suites.env.reset(seed=4), "reset")
            for step in range(8):
                actions = np.zeros(6, np.int64)
                try:
                    wanted = expected.step(actions)
                except Exception as error:
                    with pytest.raises(type(error)):
                        suites.env.step(actions)
                    assert_same(expected.reset(seed=step), suites.env.reset(seed=step), "reset")
                else:
                    assert_same(wanted, suites.env.step(actions), f"step {step}")

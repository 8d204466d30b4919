"""Stable-Baselines3 on a sandboxed environment: as on its own ``DummyVecEnv``, to the last bit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from envhub_sandbox.errors import RemoteProtocolError
from tests.support.samples import make_env_of, sample

torch = pytest.importorskip("torch")
sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.logger import Logger  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor  # noqa: E402

from envhub_sandbox.integrations.sb3 import SandboxVecEnv  # noqa: E402

pytestmark = pytest.mark.same_for("users")

_MODES = ("NextStep", "SameStep", "Disabled")
_TOLD = ("count", "ratio", "even", "text", "nothing", "sometimes", "is_success")


@pytest.fixture(params=_MODES)
def counters(request: pytest.FixtureRequest) -> Iterator[SandboxVecEnv]:
    """Three counters in a sandbox, in each autoreset mode."""
    options = {"env_kwargs": {"autoreset_mode": request.param}}
    env = SandboxVecEnv.make(sample("counter"), n_envs=3, **options)
    yield env
    env.close()


def here() -> DummyVecEnv:
    made = make_env_of(sample("counter"))(n_envs=3)
    return DummyVecEnv([lambda env=env: env for env in made.envs])


def told(infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What of infos is compared: plain values, and what Stable-Baselines3 adds."""
    added = ("TimeLimit.truncated", "terminal_observation")
    return [
        {key: np.asarray(info[key]).tolist() for key in (*_TOLD, *added) if key in info}
        for info in infos
    ]


def test_steps_are_those_of_its_own_vector_environment(counters: SandboxVecEnv) -> None:
    theirs = here()
    counters.seed(4)
    theirs.seed(4)
    assert np.array_equal(counters.reset(), theirs.reset())
    generator, ends = np.random.default_rng(0), 0
    for _ in range(60):
        actions = generator.integers(0, 3, 3)
        ours, expected = counters.step(actions), theirs.step(actions)
        for one, other in zip(ours[:3], expected[:3], strict=True):
            assert one.dtype == other.dtype
            assert np.array_equal(one, other)
        assert told(ours[3]) == told(expected[3])
        assert [info["started"] for info in counters.reset_infos] == [
            info["started"] for info in theirs.reset_infos
        ]
        ends += int(ours[2].sum())
    assert ends > 10


class _Liar(VectorEnv[Any, Any, Any]):
    """A repository's own class, of which a step returns whatever it is told to."""

    num_envs = 2
    observation_space = single_observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = single_action_space = gym.spaces.Discrete(2)
    render_mode = None

    def __init__(self, terminations: Any, infos: Any) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self._said = terminations, infos

    def step_async(self, actions: Any) -> None:
        """Nothing is done."""

    def step_wait(self) -> Any:
        terminations, infos = self._said
        return np.zeros(2), np.zeros(2), terminations, np.zeros(2, bool), infos


@pytest.mark.parametrize(
    ("terminations", "infos"),
    [
        (np.ones(2, bool), {}),
        (np.ones(2, bool), {"final_obs": np.ones(2), "final_info": np.ones(2)}),
        (np.ones((2, 2), bool), {}),
        (np.zeros(2, bool), {"a": np.ones(2), "_a": np.zeros(0, bool)}),
    ],
    ids=["no last", "no last infos", "of nobody", "no mask"],
)
def test_results_that_are_of_nobody_break_the_rules(terminations: Any, infos: Any) -> None:
    """Whatever is wrong with them, it is an error of this project."""
    env = SandboxVecEnv(_Liar(terminations, infos))
    with pytest.raises(RemoteProtocolError):
        env.step(np.zeros(2, int))


def test_options_go_to_whom_they_are_for(counters: SandboxVecEnv) -> None:
    counters.set_options([{"a": 1}, {}, {"a": 2}])
    counters.reset()
    assert [info["options"] for info in counters.reset_infos] == ["{'a': 1}", "{}", "{'a': 2}"]
    counters.set_options({"b": 3})
    counters.reset()
    assert [info["options"] for info in counters.reset_infos] == ["{'b': 3}"] * 3
    counters.reset()
    assert [info["options"] for info in counters.reset_infos] == ["None"] * 3


def test_attributes_and_methods(counters: SandboxVecEnv) -> None:
    counters.reset()
    assert counters.get_attr("index") == [0, 1, 2]
    assert counters.get_attr("index", [2, 0]) == [2, 0]
    assert counters.env_method("add", 1, b=2) == [3, 103, 203]
    counters.set_attr("gain", 2.0)
    assert counters.get_attr("gain") == [2.0] * 3
    with pytest.raises(ValueError, match="of all or of none"):
        counters.set_attr("gain", 3.0, indices=1)
    assert not counters.has_attr("nothing_of_the_kind")
    assert counters.env_is_wrapped(gym.Wrapper) == [False] * 3


@pytest.mark.parametrize("mode", _MODES)
def test_training_ends_in_the_same_weights(mode: str) -> None:
    def weights(env: Any) -> list[Any]:
        model = sb3.PPO("MlpPolicy", env, n_steps=32, n_epochs=2, seed=3, device="cpu")
        model.set_logger(Logger(None, []))  # by default it makes a folder in /tmp, and leaves it
        model.learn(192)
        returns, lengths = evaluate_policy(
            model, VecMonitor(env), n_eval_episodes=3, return_episode_rewards=True
        )
        env.close()
        return [*(one.numpy() for one in model.policy.state_dict().values()), returns, lengths]

    torch.set_num_threads(1)
    ours = weights(
        SandboxVecEnv.make(sample("cartpole"), n_envs=2, env_kwargs={"autoreset_mode": mode})
    )
    theirs = weights(DummyVecEnv([lambda: gym.make("CartPole-v1")] * 2))
    assert len(ours) == len(theirs) > 10
    assert all(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))

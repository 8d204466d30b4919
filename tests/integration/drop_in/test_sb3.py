"""Stable-Baselines3 on a sandboxed environment: as on its own ``DummyVecEnv``, to the last bit."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from envhub_sandbox.errors import RemoteProtocolError
from tests.support.repositories import STILL, write_repository
from tests.support.samples import make_env_of, sample

torch = pytest.importorskip("torch")
sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.logger import Logger  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor  # noqa: E402

from envhub_sandbox.integrations.sb3 import SandboxVecEnv  # noqa: E402

_MODES = ("NextStep", "SameStep", "Disabled")
_DESCRIBED = ("mode",)  # no plain value: it arrives as text
_PLACES = [
    *((mode, {}) for mode in _MODES),
    ("SameStep", {"num_workers": 2}),
    ("NextStep", {"num_workers": 2, "policy": {"lane": "frames"}}),
    ("Disabled", {"num_workers": 2, "min_ready": 1}),
]
_GOALS = """
import gymnasium as gym
import numpy as np

BITS = gym.spaces.MultiBinary(3)

class Goals(gym.Env):
    observation_space = gym.spaces.Dict(observation=BITS, achieved_goal=BITS, desired_goal=BITS)
    action_space = gym.spaces.Discrete(3)
    render_mode = None

    def seen(self):
        bits = self.bits.copy()
        return {"observation": bits, "achieved_goal": bits, "desired_goal": np.ones(3, np.int8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        self.bits = self.np_random.integers(0, 2, 3).astype(np.int8)
        return self.seen(), {"options": options}

    def step(self, action):
        self.count += 1
        self.bits[int(action)] ^= 1
        reward = float(self.compute_reward(self.bits, np.ones(3), None).item())
        info = {"count": self.count, "own": np.int64(3), "good": reward == 0, "reward": reward}
        return self.seen(), reward, reward == 0, self.count >= 5, info

    def compute_reward(self, achieved, desired, infos):
        distance = np.abs(achieved - desired).reshape(-1, 3).sum(axis=1)
        return -(distance > 0).astype(np.float32)

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: gym.wrappers.OrderEnforcing(Goals())] * n_envs)
"""
_PARTS = """
class Parts(Still):
    observation_space = gym.spaces.Dict(a=gym.spaces.Box(-1, 1, ()))
    action_space = gym.spaces.Dict(a=gym.spaces.Discrete(3), b=gym.spaces.Tuple(
        (gym.spaces.Box(-1, 1, (2,)), gym.spaces.MultiDiscrete([2, 3]))))

    def reset(self, *, seed=None, options=None):
        return {"a": np.zeros((), np.float32)}, {}

    def step(self, action):
        return self.reset()[0], 0.0, True, False, {"action": repr(action)}
"""
_BITS = (
    _PARTS.replace("Parts", "Bits").replace("repr(action)", "action.tolist()")
    + """
    action_space = gym.spaces.MultiBinary(3)
"""
)


@pytest.fixture(params=_MODES)
def counters(request: pytest.FixtureRequest) -> Iterator[SandboxVecEnv]:
    options = {"env_kwargs": {"autoreset_mode": request.param}}
    env = SandboxVecEnv.make(sample("counter"), n_envs=3, **options)
    yield env
    env.close()


def here() -> DummyVecEnv:
    made = make_env_of(sample("counter"))(n_envs=3)
    return DummyVecEnv([lambda env=env: env for env in made.envs])


def form(value: Any) -> Any:
    if isinstance(value, dict):
        return [(key, form(one)) for key, one in value.items() if key not in _DESCRIBED]
    if isinstance(value, (list, tuple)):
        return type(value), [form(one) for one in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return type(value), value.dtype, value.tolist()
    return type(value), value


def one_of(repository: str) -> DummyVecEnv:
    names: dict[str, Any] = {}
    exec(repository, names)
    made = names["make_env"](n_envs=2)
    return DummyVecEnv([lambda env=env: env for env in made.envs])


@pytest.mark.parametrize(("mode", "options"), _PLACES)
def test_steps_are_those_of_its_own_vector_environment(mode: str, options: Any) -> None:
    """Infos to the class of each value: those of a sub-environment are no part of an array."""
    theirs = here()
    folder, given = sample("counter"), {"env_kwargs": {"autoreset_mode": mode}}
    with closing(SandboxVecEnv.make(folder, n_envs=3, **given, **options)) as ours:
        _compare(ours, theirs)


def _compare(counters: SandboxVecEnv, theirs: DummyVecEnv) -> None:
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
        assert form(ours[3]) == form(expected[3])
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


def test_only_those_are_reset_that_did_not_begin_again() -> None:
    """A class that states no mode may begin again some of the episodes that ended."""
    final_obs = np.array([np.full(2, 7.0), None], object)
    env = _Liar(np.ones(2, bool), {"final_obs": final_obs, "_final_obs": np.array([True, False])})
    env.metadata, masks = {}, []

    def reset(*, seed: Any, options: dict[str, Any]) -> Any:
        masks.append(options["reset_mask"].tolist())
        return np.ones(2), {}

    env.reset = reset  # type: ignore[method-assign]
    infos = SandboxVecEnv(env).step(np.zeros(2, int))[3]
    assert masks == [[False, True]]
    assert [np.max(info["terminal_observation"]) for info in infos] == [7.0, 0.0]


def test_options_go_to_whom_they_are_for(counters: SandboxVecEnv) -> None:
    counters.set_options([{"a": 1}, {}, {"a": 2}])
    counters.reset()
    assert [info["options"] for info in counters.reset_infos] == ["{'a': 1}", "None", "{'a': 2}"]
    counters.set_options({"b": 3})
    counters.reset()
    assert [info["options"] for info in counters.reset_infos] == ["{'b': 3}"] * 3
    counters.reset()
    assert [info["options"] for info in counters.reset_infos] == ["None"] * 3


def test_attributes_and_methods(counters: SandboxVecEnv) -> None:
    counters.reset()
    assert (counters.get_attr("index"), counters.get_attr("index", [2, 0])) == ([0, 1, 2], [2, 0])
    assert counters.env_method("add", 1, b=2) == [3, 103, 203]
    assert counters.env_method("add", 1, indices=[0, -1, 0]) == [11, 211, 11]
    counters.set_attr("gain", 2.0)
    counters.set_attr("gain", 3.0, indices=1)
    assert (counters.get_attr("gain"), counters.envs[1].gain) == ([2.0, 3.0, 2.0], 3.0)
    with pytest.raises(TypeError, match="'float' object is not callable"):
        counters.env_method("gain")
    assert not counters.has_attr("nothing_of_the_kind")
    assert counters.has_attr("fail"), "a method is looked at, and not called"
    assert [add(1) for add in counters.get_attr("add")] == [11, 111, 211]
    assert counters.env_is_wrapped(gym.Wrapper) == [False] * 3


def test_what_a_wrapper_hides_is_found_behind_it(tmp_path: Path) -> None:
    """By each sub-environment alone as by all; an attribute is set where ``setattr`` sets it."""
    folder = write_repository(tmp_path, _GOALS)
    both = SandboxVecEnv.make(folder, n_envs=2), one_of(_GOALS)
    found: list[Any] = []
    for env in both:
        env.seed(1)
        env.set_options({"level": np.arange(2)})
        found.append([form(env.reset()), form(env.reset_infos)])
        goals = np.eye(3), np.ones((3, 3)), None
        found[-1].append(form(env.env_method("compute_reward", *goals, indices=[0])))
        env.set_attr("count", 4, indices=[1])  # in the wrapper: the environment's own stays
        found[-1].append(form(env.get_attr("count")))
        for _ in range(8):  # with an end of an episode, after which options are none
            found[-1] += [form(part) for part in env.step(np.array([0, 1]))]
        found[-1].append(form(env.reset_infos))
        env.close()
    assert found[0] == found[1]


@pytest.mark.parametrize("kind", [_PARTS, _BITS], ids=["parts", "bits"])
def test_actions_are_one_for_each(tmp_path: Path, kind: str) -> None:
    """As ``DummyVecEnv`` takes them, whatever their space; a policy draws bits as float32."""
    both = (
        SandboxVecEnv.make(write_repository(tmp_path, STILL + kind), n_envs=2),
        one_of(STILL + kind),
    )
    for env in both:
        env.action_space.seed(3)
        env.reset()
    actions: Any = [both[0].action_space.sample() for _ in range(2)]
    if kind == _BITS:
        actions = np.array(actions, np.float32)
    ours, theirs = (env.step(actions)[3] for env in both)
    assert ours == theirs
    assert form(ours[1]["terminal_observation"]) == form(theirs[1]["terminal_observation"])
    both[0].close()


def test_hindsight_of_several_environments_ends_in_the_same_weights(tmp_path: Path) -> None:
    def weights(env: Any) -> list[Any]:
        model = sb3.DQN(
            "MultiInputPolicy",
            env,
            replay_buffer_class=sb3.HerReplayBuffer,
            buffer_size=200,
            learning_starts=20,
            train_freq=2,
            batch_size=8,
            seed=3,
            device="cpu",
        )
        model.set_logger(Logger(None, []))
        model.learn(60)
        env.close()
        return [one.numpy() for one in model.policy.state_dict().values()]

    torch.set_num_threads(1)
    ours = weights(SandboxVecEnv.make(write_repository(tmp_path, _GOALS), n_envs=2))
    theirs = weights(one_of(_GOALS))
    assert len(ours) == len(theirs) > 4
    assert all(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))


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

"""Episodes are counted right in every autoreset mode, whatever the environment answers."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space

from envhub_sandbox.play.episodes import (
    MAX_COMPONENTS,
    EpisodeCounter,
    RolloutError,
    quotas,
    rollout,
    success_of,
    zero_action,
)

if not hasattr(gym.vector, "AutoresetMode"):
    pytest.skip("needs a Gymnasium with autoreset modes (1.1)", allow_module_level=True)

MODES = ["NextStep", "SameStep", "Disabled"]


class Scripted(gym.Env[Any, Any]):
    """Episodes of seeded lengths; sub-environment ``index`` earns ``index + 1`` a step. Every third
    episode is a success; a reset earns a reward that must never be counted."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, index: int) -> None:
        self.index, self.episode = index, 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, 3 + 4 * self.index))
        self.episode += 1
        return np.zeros(1, np.float32), {"is_success": True}

    def step(self, action: Any) -> Any:
        assert self.left > 0, "stepped after its end"
        self.left -= 1
        over = self.left == 0
        info = {"is_success": self.episode % 3 == 0} if over else {"is_success": False}
        return np.zeros(1, np.float32), self.index + 1.0, over and self.index == 0, over, info


def scripted(mode: str, count: int = 3) -> SyncVectorEnv:
    """``count`` of them in one autoreset mode."""
    makers = [lambda index=index: Scripted(index) for index in range(count)]
    return SyncVectorEnv(makers, autoreset_mode=gym.vector.AutoresetMode(mode))


def played_alone(index: int, episodes: int, seed: int) -> list[tuple[int, float, int, bool | None]]:
    """The oracle: one environment, one loop, no vectors."""
    env = Scripted(index)
    found: list[tuple[int, float, int, bool | None]] = []
    for number in range(episodes):
        env.reset(seed=seed + index if number == 0 else None)
        total, length, over, info = 0.0, 0, False, {"is_success": False}
        while not over:
            _, reward, terminated, truncated, info = env.step(0)
            total, length, over = total + reward, length + 1, terminated or truncated
        found.append((index, total, length, info["is_success"]))
    return found


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("episodes", [1, 3, 10])
def test_episodes_are_those_of_each_environment_alone(mode: str, episodes: int) -> None:
    result = rollout(scripted(mode), episodes=episodes, seed=5)
    found = [(e.sub_env, *e.returns, e.length, e.success) for e in result.episodes]
    expected = [
        episode
        for index, quota in enumerate(quotas(3, episodes))
        for episode in played_alone(index, quota, 5)
    ]
    assert sorted(found) == sorted(expected)
    assert result.complete
    assert all(one.terminated is (one.sub_env == 0) for one in result.episodes)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_mode_that_is_not_stated_is_found_out(mode: str) -> None:
    """Without metadata, infos with final observations give SAME_STEP away."""
    env = scripted(mode)
    env.metadata = {}
    stated = rollout(scripted(mode), episodes=9, seed=1)
    assert rollout(env, episodes=9, seed=1).episodes == stated.episodes


@pytest.mark.parametrize(("num_envs", "episodes"), [(1, 1), (3, 10), (4, 3), (5, 5), (7, 100)])
def test_quotas_add_up(num_envs: int, episodes: int) -> None:
    shares = quotas(num_envs, episodes)
    assert sum(shares) == episodes
    assert shares == sorted(shares, reverse=True)
    assert shares[0] - shares[-1] <= 1
    result = rollout(scripted("NextStep", num_envs), episodes=episodes, seed=0)
    played = [sum(e.sub_env == index for e in result.episodes) for index in range(num_envs)]
    assert played == shares, "short episodes are not favoured"


def test_the_same_seed_gives_the_same_rollout() -> None:
    def returns(seed: int) -> list[tuple[float, ...]]:
        env: Any = gym.make_vec("CartPole-v1", num_envs=3, vectorization_mode="sync")
        return [e.returns for e in rollout(env, episodes=12, seed=seed).episodes]

    assert returns(4) == returns(4)
    assert returns(4) != returns(5)


def test_max_steps_stops_and_says_so() -> None:
    steps: list[int] = []
    given: dict[str, Any] = {"episodes": 1000, "seed": 0, "max_steps": 10}
    observe = lambda counter: steps.append(counter.steps)  # noqa: E731
    result = rollout(scripted("NextStep", 1), observe=observe, **given)
    assert not result.complete
    assert result.steps <= 10
    assert sum(e.length for e in result.episodes) <= 10
    assert sorted(set(steps)) == list(range(result.steps + 1))


def test_vector_rewards_are_summed_component_by_component() -> None:
    counter = EpisodeCounter(2, 2, "SameStep")
    counter.step([[1, 2], [3, 4]], [False, True], [False, False], {})
    counter.step([[10, 20], [30, 40]], [True, True], [False, False], {})
    assert [e.returns for e in counter.counted] == [(3.0, 4.0), (11.0, 22.0)]
    counter = EpisodeCounter(1, 2, "NextStep")
    for reward, done in [(1.0, True), (100.0, True), (2.0, True)]:
        counter.step([reward], [done], [False], {})
    assert [(e.returns, e.length) for e in counter.counted] == [((1.0,), 1), ((2.0,), 1)]
    assert counter.steps == 2


def test_only_ended_environments_are_reset_by_hand() -> None:
    counter = EpisodeCounter(2, 4, "Disabled")
    counter.step([0, 0], [False, True], [False, False], {})
    assert counter.reset_mask.tolist() == [False, True]
    counter.step([0, 0], [False, False], [False, False], {})
    assert counter.reset_mask is None


@pytest.mark.parametrize(
    "rewards",
    [
        [1.0, 2.0, 3.0],
        np.zeros((2, 0)),
        np.zeros((2, MAX_COMPONENTS + 1)),
        np.zeros((2, 1, 1)),
        5.0,
        ["a", "b"],
        np.array([{}, []], object),
    ],
)
def test_rewards_that_cannot_be_counted_are_refused(rewards: Any) -> None:
    no = [False, False]
    with pytest.raises(RolloutError, match="rewards"):
        EpisodeCounter(2, 2, None).step(rewards, no, no, {})
    counter = EpisodeCounter(2, 2, None)
    counter.step([1, 2], no, no, {})
    with pytest.raises(RolloutError, match="changed their shape"):
        counter.step([[1], [2]], no, no, {})
    for flags in ([False], [no], [0.5, 0.5], ["a", "b"]):
        with pytest.raises(RolloutError, match="terminations are"):
            EpisodeCounter(2, 2, None).step([1, 2], flags, no, {})


@pytest.mark.parametrize(
    ("infos", "expected"),
    [
        ({"is_success": np.array([False, True])}, True),
        ({"is_success": np.array([1.0, 0.0]), "_is_success": np.array([True, True])}, False),
        ({"is_success": np.array([False, True]), "_is_success": np.array([True, False])}, None),
        ({"is_success": np.array([None, np.bool_(True)], object)}, True),
        ({"final_info": {"is_success": np.array([False, True])}, "is_success": [0, 0]}, True),
        ({"final_info": np.array([None, {"is_success": True}], object)}, True),
        ({"is_success": [True]}, None),
        ({"is_success": "no"}, None),
        ({"is_success": [[], []], "_is_success": 3}, None),
        ({}, None),
        ([], None),
    ],
)
def test_success_is_read_where_it_is_stated(infos: Any, expected: bool | None) -> None:
    assert success_of(infos, 1) is expected


def test_an_unknown_action_space_is_explained() -> None:
    class Own(gym.Space[Any]):
        def sample(self, *args: Any, **kwargs: Any) -> Any:
            raise gym.error.CustomSpaceError("no")

    env: VectorEnv[Any, Any, Any] = scripted("NextStep", 1)
    env.action_space = env.single_action_space = Own()
    for actions in ("random", "zero"):
        with pytest.raises(RolloutError, match="action space is a class of its own"):
            rollout(env, episodes=1, seed=0, actions=actions)


FEATURES = spaces.Box(1, 2, (2,), np.float32)
SPACES: list[gym.Space[Any]] = [
    spaces.Box(-1, 1, (2, 3), np.float32),
    spaces.Box(3, 4, (), np.float64),
    spaces.Box(np.array([-5, 2]), np.array([-3, 9]), dtype=np.int16),
    spaces.Box(-np.inf, np.inf, (1,), np.float32),
    spaces.Discrete(3, start=5),
    spaces.Discrete(3, start=-5),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([3, 2], start=[1, -4]),
    spaces.MultiBinary((2, 3)),
    spaces.Text(5, min_length=2),
    spaces.Text(3, min_length=0),
    spaces.Tuple([FEATURES, spaces.Discrete(2)]),
    spaces.Dict(b=FEATURES, a=spaces.Dict(c=spaces.Discrete(2))),
    spaces.Sequence(FEATURES),
    spaces.Sequence(FEATURES, stack=True),
    spaces.Graph(FEATURES, None),
    spaces.Graph(spaces.Discrete(4, start=1), spaces.Discrete(2)),
    spaces.OneOf([FEATURES, spaces.Discrete(2)]),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_it_is_a_member(space: gym.Space[Any]) -> None:
    assert space.contains(zero_action(space))
    batched = batch_space(space, 3)
    assert batched.contains(zero_action(batched))


def test_it_is_zero_or_the_nearest() -> None:
    """Bounds and starts pull it away from zero, and nothing else does; nothing is guessed."""
    assert zero_action(SPACES[0]).tolist() == [[0.0] * 3] * 2
    assert zero_action(SPACES[2]).tolist() == [-3, 2]
    assert [zero_action(space) for space in SPACES[4:7]] == [5, -3, 0]
    assert zero_action(SPACES[7]).tolist() == [1, -3]
    with pytest.raises(gym.error.CustomSpaceError):
        zero_action(gym.Space())

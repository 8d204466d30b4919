"""Gymnasium's vector wrappers do the same on top of the proxy as on top of SyncVectorEnv."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorEnv
from gymnasium.wrappers import vector as wrappers

from envhub_sandbox import make_env
from tests.support.compare import assert_same
from tests.support.samples import reference, sample

Wrap = Callable[[VectorEnv[Any, Any, Any]], VectorEnv[Any, Any, Any]]
WRAPS: dict[str, Wrap] = {
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "ClipReward": lambda env: wrappers.ClipReward(env, -1.0, -0.1),
    "ClipAction": wrappers.ClipAction,
    "RescaleAction": lambda env: wrappers.RescaleAction(env, -0.5, 0.5),
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, 0.0, 1.0),
    "FlattenObservation": wrappers.FlattenObservation,
    "ReshapeObservation": lambda env: wrappers.ReshapeObservation(env, (3, 1)),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float64),
    "TransformObservation": lambda env: wrappers.TransformObservation(
        env, lambda observation: observation * 2, env.observation_space
    ),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: reward**2),
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda action: action / 2),
    "VectorizeTransformAction": lambda env: wrappers.VectorizeTransformAction(
        env, gym.wrappers.RescaleAction, min_action=-0.5, max_action=0.5
    ),
    "VectorizeTransformObservation": lambda env: wrappers.VectorizeTransformObservation(
        env, gym.wrappers.ReshapeObservation, shape=(3, 1)
    ),
    "VectorizeTransformReward": lambda env: wrappers.VectorizeTransformReward(
        env, gym.wrappers.ClipReward, min_reward=-0.5
    ),
    "several": lambda env: wrappers.NormalizeReward(
        wrappers.ClipReward(wrappers.NormalizeObservation(env), -5.0, 0.0)
    ),
}


@pytest.fixture(scope="module")
def pendulums() -> Iterator[VectorEnv[Any, Any, Any]]:
    """Three sandboxed pendulums; each test wraps them anew and resets them first."""
    with make_env(sample("pendulum"), n_envs=3, use_async_envs=True) as suites:
        yield suites.env


def rollout(env: VectorEnv[Any, Any, Any], steps: int = 60) -> list[Any]:
    actions = env.unwrapped.action_space
    actions.seed(5)
    return [env.reset(seed=5), *[env.step(actions.sample()) for _ in range(steps)]]


@pytest.mark.parametrize("name", WRAPS)
def test_wrapper_gives_the_same_results(name: str, pendulums: VectorEnv[Any, Any, Any]) -> None:
    """Observations, rewards, infos and spaces under a wrapper are the reference's."""
    expected = WRAPS[name](reference("pendulum", 3))
    wrapped = WRAPS[name](pendulums)
    assert wrapped.observation_space == expected.observation_space
    assert wrapped.action_space == expected.action_space
    assert_same(rollout(expected), rollout(wrapped))


def test_episode_statistics(pendulums: VectorEnv[Any, Any, Any]) -> None:
    expected = wrappers.RecordEpisodeStatistics(reference("pendulum", 3))
    wrapped = wrappers.RecordEpisodeStatistics(pendulums)
    for env in (expected, wrapped):
        rollout(env)
    assert len(expected.return_queue) == 6
    assert_same(list(expected.return_queue), list(wrapped.return_queue))
    assert_same(list(expected.length_queue), list(wrapped.length_queue))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_dict_info_to_list(mode: str) -> None:
    """DictInfoToList takes the infos apart again, masks and final infos included."""
    kwargs = {"autoreset_mode": mode}
    expected = wrappers.DictInfoToList(reference("counter", 2, **kwargs))
    with make_env(sample("counter"), n_envs=2, env_kwargs=kwargs) as suites:
        wrapped = wrappers.DictInfoToList(suites.env)
        assert_same(rollout(expected), rollout(wrapped))


def test_numpy_to_torch(pendulums: VectorEnv[Any, Any, Any]) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("array_api_compat")
    results = []
    for env in (reference("pendulum", 3), pendulums):
        wrapped = wrappers.NumpyToTorch(env)
        first = wrapped.reset(seed=1)
        results.append([first, wrapped.step(torch.full((3, 1), 0.5))])
    assert_same(*results)
    assert isinstance(results[1][1][1], torch.Tensor)


def test_dict_observations_under_wrappers() -> None:
    def wrap(env: VectorEnv[Any, Any, Any]) -> VectorEnv[Any, Any, Any]:
        return wrappers.FlattenObservation(wrappers.FilterObservation(env, ["agent_pos"]))

    expected = wrap(reference("lerobot_pendulum", 2))
    with make_env(sample("lerobot_pendulum"), n_envs=2) as suites:
        assert_same(rollout(expected), rollout(wrap(suites.env)))


def test_record_video(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    frames = {}
    with make_env(sample("lerobot_pendulum"), n_envs=2) as suites:
        for name, env in (("expected", reference("lerobot_pendulum", 2)), ("wrapped", suites.env)):
            folder = tmp_path / name
            recorder = wrappers.RecordVideo(env, str(folder), episode_trigger=lambda _: True)
            rollout(recorder, steps=15)
            frames[name] = list(recorder.recorded_frames)
            recorder.stop_recording()
            [video] = folder.glob("*.mp4")
            assert b"ftyp" in video.read_bytes()[:16]
    assert len(frames["expected"]) == 16
    assert_same(frames["expected"], frames["wrapped"])

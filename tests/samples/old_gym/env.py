"""Environments of gym, Gymnasium's predecessor, in the ways that its releases knew."""

import gym
import numpy as np
from gym import spaces


class Walk(gym.Env):
    """As before 0.22: ``seed()``, a bare observation, one ``done``, and a mode to render in."""

    metadata = {"render.modes": ["rgb_array"], "video.frames_per_second": 20}  # noqa: RUF012

    def __init__(self):
        self.gain = 1.0
        self.action_space = spaces.Dict(
            {"turn": spaces.Discrete(3), "push": spaces.Box(-1.0, 1.0, (2,), np.float32)}
        )
        self.observation_space = spaces.Dict(
            {
                "place": spaces.Box(-np.inf, np.inf, (2,), np.float32),
                "pair": spaces.Tuple((spaces.MultiDiscrete([3, 100]), spaces.MultiBinary(4))),
            }
        )
        self.seed()

    def seed(self, seed=None):
        self.random = np.random.RandomState(seed)
        return [seed]

    def reset(self):
        self.place = self.random.uniform(-1, 1, 2).astype(np.float32)
        self.count = 0
        return self._observation(0)

    def step(self, action):
        self.count += 1
        self.place = (self.place + self.gain * action["push"]).astype(np.float32)
        done = bool(self.random.uniform() < 0.05)
        return self._observation(action["turn"]), float(self.place.sum()), done, {"n": self.count}

    def _observation(self, turn):
        bits = self.random.randint(0, 2, 4).astype(np.int8)
        return {"place": self.place, "pair": (np.array([turn, min(self.count, 99)]), bits)}

    def render(self, mode="human"):
        if mode != "rgb_array":
            raise NotImplementedError(mode)
        return np.full((4, 4, 3), self.count, np.uint8)

    def distance(self, scale=1):
        return float(np.abs(self.place).sum()) * scale


class Doubled(gym.RewardWrapper):
    """A wrapper of gym's own."""

    def reward(self, reward):
        return 2 * reward


def wrapped():
    return Doubled(gym.wrappers.TimeLimit(Walk(), 12))


def cartpole():
    return gym.make("CartPole-v1")


def old_names():
    """With what numpy 1.24 and 2 have taken away."""
    assert np.int(np.float_(np.float(1)))
    assert [np.bool, np.object, np.Inf]
    return cartpole()


MAKERS = {"walk": Walk, "wrapped": wrapped, "cartpole": cartpole, "old_names": old_names}


def make_env(n_envs=1, use_async_envs=False, kind="walk", around="nothing"):
    make = MAKERS[kind]
    if around == "gymnasium":
        import gymnasium

        return gymnasium.vector.SyncVectorEnv([make] * n_envs)
    if around == "gym":
        vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
        return vector([make] * n_envs)
    return make()

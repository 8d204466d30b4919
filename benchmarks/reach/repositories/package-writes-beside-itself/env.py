import gymnasium as gym
import numpy as np
import rlcard


class Doudizhu(gym.Env):
    """One of three players; the others are played by the same hand."""

    observation_space = gym.spaces.Box(0, 1, (790,), np.int8)
    action_space = gym.spaces.Discrete(1000)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.game = rlcard.make("doudizhu", config={"seed": seed})
        self.state, _ = self.game.reset()
        return self._observation(), {}

    def step(self, action):
        legal = sorted(self.state["legal_actions"])
        self.state, _ = self.game.step(legal[action % len(legal)])
        return self._observation(), float(len(legal)), self.game.is_over(), False, {}

    def _observation(self):
        return np.resize(self.state["obs"], 790).astype(np.int8)


def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Doudizhu] * n_envs)

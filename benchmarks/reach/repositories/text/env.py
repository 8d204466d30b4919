import gymnasium as gym
import inflect


class Numbers(gym.Env):
    """Counts in words."""

    observation_space = gym.spaces.Text(64, charset="abcdefghijklmnopqrstuvwxyz -,")
    action_space = gym.spaces.Text(8)

    def __init__(self):
        self.words = inflect.engine()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = int(self.np_random.integers(100))
        return self.words.number_to_words(self.count), {}

    def step(self, action):
        self.count += len(action)
        return self.words.number_to_words(self.count), float(len(action)), False, False, {}


def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Numbers] * n_envs)

"""A vector environment that does not inherit from Gymnasium's, but walks like it."""

import gymnasium as gym


class LazyCartPoles:
    """Builds the real thing when it is first needed."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        env = gym.make("CartPole-v1")
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.observation_space = gym.vector.utils.batch_space(env.observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(env.action_space, num_envs)
        self.metadata = {"render_fps": 50, "autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}
        self.nickname = "duck"
        self._envs = None

    @property
    def envs(self):
        if self._envs is None:
            fns = [lambda: gym.make("CartPole-v1")] * self.num_envs
            self._envs = gym.vector.SyncVectorEnv(fns)
        return self._envs

    def reset(self, **kwargs):
        return self.envs.reset(**kwargs)

    def step(self, actions):
        return self.envs.step(actions)

    def call(self, name, *args, **kwargs):
        return self.envs.call(name, *args, **kwargs)

    def close(self):
        if self._envs is not None:
            self._envs.close()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> LazyCartPoles:
    return LazyCartPoles(n_envs)

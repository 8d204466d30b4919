import gym


def make_env(n_envs=1, use_async_envs=False):
    return gym.make("CartPole-v1")

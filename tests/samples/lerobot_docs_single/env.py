"""The example of LeRobot's EnvHub documentation, as it stands there."""

import gymnasium as gym


def make_env(n_envs: int = 1, use_async_envs: bool = False):
    """Create vectorized environments for your custom task."""

    def _make_single_env():
        # Create your custom environment
        return gym.make("CartPole-v1")

    # Choose vector environment type
    env_cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    # Create vectorized environment
    vec_env = env_cls([_make_single_env for _ in range(n_envs)])

    return vec_env  # noqa: RET504

"""MiniGrid: a mission in words, whose space is a class of minigrid's own."""

import gymnasium as gym
import minigrid  # noqa: F401 (registers the environments)


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, autoreset_mode: str = "NextStep"
) -> gym.vector.VectorEnv:
    def one() -> gym.Env:
        return gym.make("MiniGrid-GoToDoor-5x5-v0", render_mode="rgb_array", max_episode_steps=30)

    if use_async_envs:  # Gymnasium cannot put a mission in shared memory
        return gym.vector.AsyncVectorEnv(
            [one] * n_envs, shared_memory=False, autoreset_mode=autoreset_mode
        )
    return gym.vector.SyncVectorEnv([one] * n_envs, autoreset_mode=autoreset_mode)

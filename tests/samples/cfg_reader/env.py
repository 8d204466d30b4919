"""Builds what the caller's config object asks for, fields and nested fields alike."""

import gymnasium as gym


class Configured(gym.Wrapper):
    """Remembers what it was told."""

    def __init__(self, cfg) -> None:
        super().__init__(gym.make(cfg.task, max_episode_steps=cfg.episode_length))
        self.camera_width = cfg.camera["width"]  # a dict
        self.robot = cfg.robot.name  # an object
        self.told = sorted(vars(cfg))


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg=None) -> gym.vector.VectorEnv:
    if cfg is None:
        raise ValueError("this environment wants a config")
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: Configured(cfg)] * n_envs)

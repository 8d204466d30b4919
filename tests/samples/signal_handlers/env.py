"""Wants to tidy up on Ctrl-C: signal handlers can only be set on the main thread."""

import os
import signal
import threading

import gymnasium as gym

signal.signal(signal.SIGINT, lambda *_: os._exit(130))
signal.signal(signal.SIGTERM, lambda *_: os._exit(143))
ON_MAIN_THREAD = threading.current_thread() is threading.main_thread()


class Tidy(gym.Wrapper):
    """Knows the thread that built it and the one that steps it."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.imported_on_main_thread = ON_MAIN_THREAD
        self.built_on_main_thread = threading.current_thread() is threading.main_thread()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: Tidy(gym.make("CartPole-v1"))] * n_envs)

"""HalfCheetah whose observation is its picture, 480x640, rendered off screen by MuJoCo."""

import gymnasium as gym
import numpy as np


class Pictures(gym.ObservationWrapper):
    """Not AddRenderObservation: it resets and renders once unseeded, and the camera remembers."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (480, 640, 3), np.uint8)

    def observation(self, observation: object) -> object:
        """The picture instead."""
        return self.env.render()

    def renderer(self) -> str:
        """What OpenGL calls the one that has drawn it; llvmpipe where no GPU was found."""
        from OpenGL import GL

        return GL.glGetString(GL.GL_RENDERER).decode()


def single() -> gym.Env:
    """One sub-environment."""
    return Pictures(gym.make("HalfCheetah-v5", render_mode="rgb_array", width=640, height=480))


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)

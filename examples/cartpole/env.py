"""Gymnasium's CartPole, drawn with numpy, so that nothing else has to be installed.

Try it::

    envhub run ./examples/cartpole --episodes 4 --n-envs 2 --video cartpole.mp4
"""

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.wrappers import TimeLimit

HEIGHT, WIDTH = 128, 240
GROUND, POLE = 96, 60  # pixels from the top, pixels of length
SKY, SOIL, CART, WOOD = (236, 240, 245), (170, 160, 140), (40, 60, 90), (200, 120, 50)


class DrawnCartPole(CartPoleEnv):
    """Keep the pole up by pushing the cart left (0) or right (1)."""

    def render(self):
        """A uint8 frame of shape ``(128, 240, 3)``."""
        frame = np.full((HEIGHT, WIDTH, 3), SKY, np.uint8)
        frame[GROUND:] = SOIL
        position, _, angle, _ = (0, 0, 0, 0) if self.state is None else self.state
        column = int(WIDTH / 2 * (1 + position / self.x_threshold))
        frame[GROUND - 12 : GROUND, max(column - 16, 0) : max(column + 16, 0)] = CART
        along = np.linspace(0, POLE, 2 * POLE)
        rows = (GROUND - 12 - along * np.cos(angle)).astype(int)
        columns = (column + along * np.sin(angle)).astype(int)
        for offset in range(-2, 3):
            seen = (columns + offset >= 0) & (columns + offset < WIDTH)
            frame[rows[seen], columns[seen] + offset] = WOOD
        return frame


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    def one() -> gym.Env:
        return TimeLimit(DrawnCartPole(render_mode="rgb_array"), max_episode_steps=500)

    return vector([one] * n_envs)

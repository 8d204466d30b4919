"""A hostile repository: its environment runs whichever payload the test names, when it says."""

import gymnasium as gym
import numpy as np
from payloads import running

STAGES = ("import", "make_env", "reset", "step", "render", "close", "call")


class Hostile(gym.Env):
    """Does nothing but attack."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    render_mode = "rgb_array"

    def __init__(self, order=None):
        self._order = order or {}
        self.loot = []

    def attack(self, name, arguments, alias):
        return running.run(name, arguments, alias)

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), self._maybe("reset")

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, self._maybe("step")

    def render(self):
        self.loot.append(self._maybe("render"))
        return np.zeros((2, 2, 3), np.uint8)

    def close(self):
        self._maybe("close")

    def _maybe(self, stage):
        if self._order.get("stage") != stage:
            return {}
        return {"loot": running.run(**self._order["attack"])}


def make_env(n_envs=1, use_async_envs=False, order=None):
    loot = None
    if order and order["stage"] == "make_env":
        loot = running.run(**order["attack"])
    env = Hostile(order)
    env.loot.append(loot)
    return gym.vector.SyncVectorEnv([lambda: env])

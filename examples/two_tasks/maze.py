"""A square room to walk in."""

import gymnasium as gym
import numpy as np

MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
FLOOR, WALKER, GOAL, KEY = (245, 245, 240), (50, 90, 200), (60, 170, 90), (230, 180, 40)


class Maze(gym.Env):
    """Observation: row and column of the walker, the goal and the key, and whether it has it.

    Actions: up, down, left, right. Each step costs 0.01; arriving with what the task asks for
    ends the episode with a reward of 1.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, task_description: str, needs_key: bool, size: int) -> None:
        self.task_description = task_description
        self.needs_key = needs_key
        self.size = size
        self._max_episode_steps = 4 * size * size
        self.observation_space = gym.spaces.Box(0, size - 1, (7,), np.float32)
        self.action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        cells = self.np_random.choice(self.size**2, 3, replace=False)
        self.walker, self.goal, self.key = (
            np.array(divmod(int(cell), self.size)) for cell in cells
        )
        self.has_key = not self.needs_key
        self.steps = 0
        return self._observe(), {"is_success": False}

    def step(self, action):
        self.steps += 1
        self.walker = np.clip(self.walker + MOVES[int(action)], 0, self.size - 1)
        self.has_key = self.has_key or bool((self.walker == self.key).all())
        arrived = self.has_key and bool((self.walker == self.goal).all())
        reward = 1.0 if arrived else -0.01
        too_long = self.steps >= self._max_episode_steps
        return self._observe(), reward, arrived, too_long, {"is_success": arrived}

    def render(self):
        """A uint8 frame of shape ``(16 * size, 16 * size, 3)``."""
        cells = np.full((self.size, self.size, 3), FLOOR, np.uint8)
        cells[tuple(self.goal)] = GOAL
        if not self.has_key:
            cells[tuple(self.key)] = KEY
        cells[tuple(self.walker)] = WALKER
        return cells.repeat(16, axis=0).repeat(16, axis=1)

    def _observe(self):
        return np.array([*self.walker, *self.goal, *self.key, self.has_key], np.float32)

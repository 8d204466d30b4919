"""Catch: a camera and a robot state, the way LeRobot's policies expect them.

Try it::

    envhub run ./examples/catch --episodes 8 --n-envs 4 --video catch.mp4
"""

import gymnasium as gym
import numpy as np

SIZE = 64
SKY, BALL, TRAY = (20, 24, 40), (250, 210, 80), (90, 200, 160)


class Catch(gym.Env):
    """A ball falls; be under it when it lands. The action is the tray's velocity."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    render_mode = "rgb_array"
    task = "catch"
    task_description = "catch the ball with the tray"
    _max_episode_steps = 60

    observation_space = gym.spaces.Dict(
        {
            "agent_pos": gym.spaces.Box(0, 1, (1,), np.float32),
            "pixels": gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.tray = 0.5
        self.ball = np.array([self.np_random.uniform(0.1, 0.9), 0.0])
        self.drift = self.np_random.uniform(-0.01, 0.01)
        return self._observe(), {"is_success": False}

    def step(self, action):
        self.tray = float(np.clip(self.tray + 0.05 * np.clip(action[0], -1, 1), 0, 1))
        self.ball += (self.drift, 0.02)
        landed = bool(self.ball[1] >= 0.92)
        caught = landed and bool(abs(self.ball[0] - self.tray) < 0.12)
        return self._observe(), float(caught), landed, False, {"is_success": caught}

    def render(self):
        """A uint8 frame of shape ``(64, 64, 3)``."""
        frame = np.full((SIZE, SIZE, 3), SKY, np.uint8)
        _block(frame, self.ball[1], self.ball[0], 2, 2, BALL)
        _block(frame, 0.95, self.tray, 1, 7, TRAY)
        return frame

    def _observe(self):
        return {"agent_pos": np.array([self.tray], np.float32), "pixels": self.render()}


def _block(frame, y, x, half_height, half_width, colour):
    row, column = int(y * (SIZE - 1)), int(x * (SIZE - 1))
    rows = slice(max(row - half_height, 0), row + half_height + 1)
    frame[rows, max(column - half_width, 0) : column + half_width + 1] = colour


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([Catch] * n_envs)

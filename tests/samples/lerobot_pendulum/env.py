"""Pendulum dressed for LeRobot: ``agent_pos``, a task in words, ``is_success`` in every info."""

import gymnasium as gym
import numpy as np

EPISODE_LENGTH = 20


class SwingUp(gym.Wrapper):
    """What a LeRobot policy looks for in an environment."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, task: str) -> None:
        super().__init__(gym.make("Pendulum-v1", render_mode="rgb_array").unwrapped)
        self.observation_space = gym.spaces.Dict({"agent_pos": self.env.observation_space})
        self.task = task
        self.task_description = f"{task.replace('_', ' ')} the pendulum"
        self._max_episode_steps = EPISODE_LENGTH
        self._steps = 0

    def reset(self, *, seed=None, options=None):
        self._steps = 0
        observation, _ = self.env.reset(seed=seed)
        return {"agent_pos": observation}, {"is_success": False}

    def step(self, action):
        self._steps += 1
        observation, reward, _, _, _ = self.env.step(action)
        upright = bool(observation[0] > 0.95)
        truncated = self._steps >= EPISODE_LENGTH
        return {"agent_pos": observation}, reward, upright, truncated, {"is_success": upright}

    def render(self):
        """A grey frame whose bright column points where the pendulum points."""
        angle = (self.env.state[0] + np.pi) % (2 * np.pi) - np.pi
        frame = np.full((32, 32, 3), 90, np.uint8)
        frame[:, int((angle + np.pi) / (2 * np.pi) * 31)] = 255
        return frame


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    autoreset_mode: str = "NextStep",
    task: str = "swing_up",
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: SwingUp(task)] * n_envs, autoreset_mode=autoreset_mode)

"""A simulator that steps all its robots at once and answers in torch tensors.

The shape of LeRobot's IsaacLab Arena environments: ``policy`` and ``camera_obs`` hold tensors,
the vector environment is a class of its own and carries its configuration along.
"""

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

SINGLE = spaces.Dict(
    {
        "policy": spaces.Dict({"joint_pos": spaces.Box(-np.inf, np.inf, (3,))}),
        "camera_obs": spaces.Dict({"front": spaces.Box(0, 255, (4, 4, 3), np.uint8)}),
    }
)


class Arena(VectorEnv):
    """Joints that drift where the action says."""

    metadata = {"render_fps": 50, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = SINGLE
        self.single_action_space = spaces.Box(-1, 1, (3,))
        self.observation_space = gym.vector.utils.batch_space(SINGLE, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.hub_config = {"embodiment": "gr1", "cameras": ["front"]}
        self.joints = torch.zeros(num_envs, 3)
        self.steps = torch.zeros(num_envs, dtype=torch.int64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        start = self.np_random.uniform(-1, 1, (self.num_envs, 3))
        self.joints = torch.as_tensor(start, dtype=torch.float32)
        self.steps.zero_()
        return self._observe(), {}

    def step(self, actions):
        self.joints += torch.as_tensor(actions, dtype=torch.float32)
        self.steps += 1
        rewards = -self.joints.norm(dim=1).double().numpy()
        truncated = (self.steps >= 10).numpy()
        self.steps[torch.as_tensor(truncated)] = 0
        return self._observe(), rewards, np.zeros(self.num_envs, bool), truncated, {}

    def call(self, name, *args, **kwargs):
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def _observe(self):
        camera = (self.joints.abs() * 10).to(torch.uint8)[:, None, None, :].expand(-1, 4, 4, -1)
        return {"policy": {"joint_pos": self.joints.clone()}, "camera_obs": {"front": camera}}


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> VectorEnv:
    return Arena(n_envs)

"""Pendulums that torch steps in one batch, on a GPU if there is one: the shape of Isaac Lab."""

import os

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv


class Pendulums(VectorEnv):
    """All of them are tensors on one device; what leaves it is copied into arrays."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, count: int, substeps: int) -> None:
        self.num_envs, self.substeps = count, substeps
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (3,))
        self.single_action_space = gym.spaces.Box(-2, 2, (1,))
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, count)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, count)
        self.held: list[torch.Tensor] = []

    def reset(self, *, seed=None, options=None):
        """As VectorEnv."""
        super().reset(seed=seed)
        start = self.np_random.uniform(-1, 1, (2, self.num_envs)).astype(np.float32)
        self.angle, self.speed = torch.as_tensor(start).to(self.device)
        return self._observed(), {}

    def step(self, actions):
        """As VectorEnv; nobody's episode ends."""
        torque = torch.as_tensor(np.asarray(actions)[:, 0]).to(self.device)
        for _ in range(self.substeps):
            self.speed = self.speed + 0.01 * (15 * torch.sin(self.angle) + 3 * torque)
            self.angle = self.angle + 0.01 * self.speed
        rewards = -(self.angle**2 + 0.1 * self.speed**2).double().cpu().numpy()
        ends = np.zeros(self.num_envs, bool)
        return self._observed(), rewards, ends, ends.copy(), {}

    def _observed(self):
        seen = torch.stack([torch.cos(self.angle), torch.sin(self.angle), self.speed], dim=1)
        return seen.cpu().numpy()

    def call(self, name, *args, **kwargs):
        """As VectorEnv."""
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def card(self):
        """The device's name; what torch would say if there were none."""
        return torch.cuda.get_device_name() if self.device.type == "cuda" else "none"

    def hold(self, mib: int):
        """Take memory of the card; the bytes that the card then says are free."""
        self.held.append(torch.ones(mib << 20, dtype=torch.uint8, device=self.device))
        torch.cuda.synchronize()
        return torch.cuda.mem_get_info()[0]

    def crash(self):
        """End at once, as a fault of a driver would."""
        os.abort()


def make_env(n_envs: int = 1, use_async_envs: bool = False, substeps: int = 20) -> VectorEnv:
    """The entry point of every environment repository."""
    return Pendulums(n_envs, substeps)

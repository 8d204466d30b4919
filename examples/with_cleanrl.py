"""A loop as CleanRL writes it, with its environments here and in the sandbox: the same weights.

    python examples/with_cleanrl.py            # needs torch

Only the line that makes the environments differs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from envhub_sandbox import make_env

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install torch") from None

CARTPOLE = str(Path(__file__).with_name("cartpole"))


def train(envs: Any, updates: int = 10, steps: int = 32) -> list[torch.Tensor]:
    """Policy gradient with a baseline; returns the weights."""
    torch.manual_seed(1)
    envs = RecordEpisodeStatistics(envs)
    inputs = int(np.prod(envs.single_observation_space.shape))
    agent = torch.nn.Sequential(
        torch.nn.Linear(inputs, 32), torch.nn.Tanh(), torch.nn.Linear(32, 3)
    )
    optimizer = torch.optim.Adam(agent.parameters(), lr=2.5e-3, eps=1e-5)
    observation, _ = envs.reset(seed=1)
    for _ in range(updates):
        kept = []
        for _ in range(steps):
            heads = agent(torch.from_numpy(observation))
            distribution = torch.distributions.Categorical(logits=heads[:, :2])
            action = distribution.sample()
            observation, reward, terminated, truncated, _ = envs.step(action.numpy())
            ended = torch.from_numpy(np.logical_or(terminated, truncated))
            kept.append((distribution.log_prob(action), heads[:, 2], reward, ended))
        gain, loss = torch.zeros(envs.num_envs), torch.zeros(())
        for log_prob, value, reward, ended in reversed(kept):
            gain = torch.from_numpy(reward).float() + 0.99 * gain * ~ended
            loss = loss - (log_prob * (gain - value.detach())).mean() + (gain - value).pow(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    envs.close()
    return [weight.detach() for weight in agent.parameters()]


def here() -> Any:
    """As CleanRL makes them."""
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 4)


if __name__ == "__main__":
    torch.set_num_threads(1)
    ours = train(make_env(CARTPOLE, n_envs=4).env)
    theirs = train(here())
    same = all(torch.equal(one, other) for one, other in zip(ours, theirs, strict=True))
    print(f"the weights are the same, to the last bit: {same}")

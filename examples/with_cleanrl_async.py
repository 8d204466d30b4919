"""A loop in CleanRL's manner that waits for the first environments that are ready, not for all.

    python examples/with_cleanrl_async.py      # needs torch

``recv`` gives four of eight sub-environments at a time. While the policy chooses their actions, and
while it learns, the others step. Each has a trajectory of its own, since they are not in step with
one another; PPO's ratio allows for a policy that is a little newer than the one that acted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envhub_sandbox import make_env

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install torch") from None

CARTPOLE = str(Path(__file__).with_name("cartpole"))
LENGTH, GAMMA, CLIP = 32, 0.99, 0.2


class Step(NamedTuple):
    """What one sub-environment did: where it was, what it chose and how likely, what it got."""

    observation: Any
    action: int
    log_prob: float
    following: Any
    reward: float
    ended: bool


class Trajectories:
    """The steps of each sub-environment since its last full trajectory."""

    def __init__(self, count: int) -> None:
        self._chosen: list[tuple[Any, int, float] | None] = [None] * count
        self._steps: list[list[Step]] = [[] for _ in range(count)]
        self._over = [False] * count
        self.full: list[list[Step]] = []
        self.lengths: list[int] = []
        self._length = [0] * count

    def receive(self, received: Any) -> None:
        """Complete the steps whose results these are."""
        ended = np.logical_or(received.terminations, received.truncations)
        for place, index in enumerate(received.env_ids.tolist()):
            chosen, over = self._chosen[index], self._over[index]
            self._over[index] = bool(ended[place])
            if over or chosen is None:  # Gymnasium's autoreset: this step was a reset
                continue
            self._length[index] += 1
            if ended[place]:
                self.lengths.append(self._length[index])
                self._length[index] = 0
            steps = self._steps[index]
            got = received.observations[place], float(received.rewards[place]), bool(ended[place])
            steps.append(Step(*chosen, *got))
            if len(steps) == LENGTH:
                self.full.append(steps)
                self._steps[index] = []

    def choose(self, received: Any, actions: Any, log_probs: Any) -> None:
        """Remember what was chosen for these."""
        rows = zip(received.observations, actions.tolist(), log_probs.tolist(), strict=True)
        for index, row in zip(received.env_ids.tolist(), rows, strict=True):
            self._chosen[index] = row


def learn(agent: Any, optimizer: Any, trajectories: list[list[Step]]) -> None:
    """One update of all steps of some trajectories."""
    gains: list[float] = []
    for steps in trajectories:
        with torch.no_grad():
            gain = float(agent(torch.from_numpy(steps[-1].following))[2])
        found: list[float] = []
        for step in reversed(steps):
            gain = step.reward + GAMMA * gain * (not step.ended)
            found.append(gain)
        gains += found[::-1]
    steps = [step for some in trajectories for step in some]
    observations = torch.from_numpy(np.stack([step.observation for step in steps]))
    actions = torch.tensor([step.action for step in steps])
    before = torch.tensor([step.log_prob for step in steps])
    targets = torch.tensor(gains)
    for _ in range(4):
        heads = agent(observations)
        distribution = torch.distributions.Categorical(logits=heads[:, :2])
        advantage = targets - heads[:, 2].detach()
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        ratio = (distribution.log_prob(actions) - before).exp()
        clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
        loss = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        loss = loss + 0.5 * (heads[:, 2] - targets).pow(2).mean() / targets.var()
        loss = loss - 0.01 * distribution.entropy().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def train(envs: Any, updates: int = 30, batch: int = 16) -> list[int]:
    """Learn from trajectories as they come in; returns the lengths of episodes, in order."""
    torch.manual_seed(1)
    inputs = int(np.prod(envs.single_observation_space.shape))
    agent = torch.nn.Sequential(
        torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 3)
    )
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-2, eps=1e-5)
    trajectories = Trajectories(envs.num_envs)
    envs.send_reset(seed=1)
    for _ in range(updates):
        while len(trajectories.full) < batch:
            received = envs.recv()
            trajectories.receive(received)
            with torch.no_grad():
                logits = agent(torch.from_numpy(received.observations))[:, :2]
                distribution = torch.distributions.Categorical(logits=logits)
                actions = distribution.sample()
            trajectories.choose(received, actions, distribution.log_prob(actions))
            envs.send(actions.numpy(), received.env_ids)
        learn(agent, optimizer, trajectories.full)  # while the environments are at their steps
        trajectories.full = []
    return trajectories.lengths


if __name__ == "__main__":
    torch.set_num_threads(1)
    with make_env(CARTPOLE, n_envs=8, min_ready=4) as suites:
        lengths = train(suites.env)
    first, last = (float(np.mean(some)) for some in (lengths[:20], lengths[-20:]))
    print(f"{len(lengths)} episodes: the first last {first:.0f} steps, the last {last:.0f}")

"""Training loops written for Gymnasium run on the proxy unchanged, to the same weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from envhub_sandbox import make_env
from tests.support.compare import assert_same
from tests.support.samples import reference, sample

torch = pytest.importorskip("torch")
nn = torch.nn

Weights = list[np.ndarray[Any, Any]]


def linear(inputs: int, outputs: int) -> Any:
    """A small network."""
    return nn.Sequential(nn.Linear(inputs, 32), nn.Tanh(), nn.Linear(32, outputs))


def weights(network: Any) -> Weights:
    """A network's parameters as arrays."""
    return [parameter.detach().numpy().copy() for parameter in network.parameters()]


def ppo(envs: VectorEnv[Any, Any, Any], updates: int = 3, num_steps: int = 32) -> Weights:
    """CleanRL's PPO, short: collect, estimate advantages, optimise the clipped objective."""
    torch.manual_seed(1)
    envs = RecordEpisodeStatistics(envs)
    shape = (num_steps, envs.num_envs)
    inputs = int(np.prod(envs.single_observation_space.shape))
    agent = nn.ModuleList([linear(inputs, int(envs.single_action_space.n)), linear(inputs, 1)])
    actor, critic = agent
    optimizer = torch.optim.Adam(agent.parameters(), lr=2.5e-3, eps=1e-5)
    obs = torch.zeros((*shape, inputs))
    actions, logprobs, rewards, dones, values = (torch.zeros(shape) for _ in range(5))
    next_obs, _ = envs.reset(seed=1)
    next_obs = torch.Tensor(next_obs)
    next_done = torch.zeros(envs.num_envs)
    for _ in range(updates):
        for step in range(num_steps):
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                distribution = torch.distributions.Categorical(logits=actor(next_obs))
                action = distribution.sample()
                values[step] = critic(next_obs).flatten()
            actions[step], logprobs[step] = action, distribution.log_prob(action)
            observation, reward, terminations, truncations, _ = envs.step(action.cpu().numpy())
            rewards[step] = torch.tensor(reward).view(-1)
            next_obs = torch.Tensor(observation)
            next_done = torch.Tensor(np.logical_or(terminations, truncations))
        advantages = _advantages(rewards, values, dones, next_done, critic(next_obs).detach())
        _improve(agent, optimizer, obs, actions, logprobs, advantages, advantages + values)
    return weights(agent)


def _advantages(rewards: Any, values: Any, dones: Any, next_done: Any, next_value: Any) -> Any:
    advantages, last = torch.zeros_like(rewards), 0.0
    after, going_on = next_value.flatten(), 1.0 - next_done
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + 0.99 * after * going_on - values[t]
        advantages[t] = last = delta + 0.99 * 0.95 * going_on * last
        after, going_on = values[t], 1.0 - dones[t]
    return advantages


def _improve(
    agent: Any, optimizer: Any, obs: Any, actions: Any, old: Any, advantages: Any, returns: Any
) -> None:
    actor, critic = agent
    flat = obs.reshape(-1, obs.shape[-1])
    distribution = torch.distributions.Categorical(logits=actor(flat))
    ratio = (distribution.log_prob(actions.flatten()) - old.flatten()).exp()
    gain = advantages.flatten()
    policy_loss = -torch.min(gain * ratio, gain * ratio.clamp(0.8, 1.2)).mean()
    value_loss = (critic(flat).flatten() - returns.flatten()).pow(2).mean()
    optimizer.zero_grad()
    (policy_loss + 0.5 * value_loss - 0.01 * distribution.entropy().mean()).backward()
    optimizer.step()


def dqn(envs: VectorEnv[Any, Any, Any], steps: int = 150, batch: int = 32) -> Weights:
    """CleanRL's DQN, short: epsilon-greedy into a replay buffer, one gradient step a step."""
    torch.manual_seed(2)
    rng = np.random.default_rng(2)
    network = linear(4, 2)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    buffer: list[tuple[Any, ...]] = []
    envs.action_space.seed(2)
    obs, _ = envs.reset(seed=2)
    for _ in range(steps):
        actions = envs.action_space.sample()
        greedy = network(torch.from_numpy(obs)).argmax(1).numpy()
        explore = rng.random(envs.num_envs) < 0.2
        actions = np.where(explore, actions, greedy)
        next_obs, rewards, terminations, _, _ = envs.step(actions)
        buffer.extend(zip(obs, actions, rewards, next_obs, terminations, strict=True))
        obs = next_obs
        if len(buffer) >= batch:
            chosen = [buffer[i] for i in rng.integers(len(buffer), size=batch)]
            _td_step(network, optimizer, *map(np.array, zip(*chosen, strict=True)))
    return weights(network)


def _td_step(
    network: Any, optimizer: Any, obs: Any, actions: Any, rewards: Any, after: Any, ended: Any
) -> None:
    with torch.no_grad():
        best = network(torch.from_numpy(after)).max(1).values
        target = torch.from_numpy(rewards).float() + 0.99 * best * torch.from_numpy(~ended)
    chosen = torch.from_numpy(actions)[:, None]
    value = network(torch.from_numpy(obs)).gather(1, chosen).squeeze(1)
    loss = nn.functional.mse_loss(target, value)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


@pytest.mark.parametrize("use_async_envs", [False, True])
@pytest.mark.parametrize("train", [ppo, dqn])
def test_training_ends_in_the_same_weights(train: Any, use_async_envs: bool) -> None:
    """The same seeds give the same network, to the last bit, in process and sandboxed."""
    expected = train(reference("cartpole", 4))
    with make_env(sample("cartpole"), n_envs=4, use_async_envs=use_async_envs) as suites:
        assert_same(expected, train(suites.env))

"""Learn to balance a pole by random search, in a sandbox, in a few seconds.

    python examples/train_random_search.py

The policy is linear: push right if ``weights @ observation > 0``. Each generation tries a handful
of weights around the best so far, one per sub-environment, so that they play side by side.
"""

from pathlib import Path
from typing import Any

import numpy as np

from envhub_sandbox import make_env

Array = np.ndarray[Any, Any]

CARTPOLE = Path(__file__).parent / "cartpole"
CANDIDATES = 16
GOOD_ENOUGH = 450.0


def play(env: Any, weights: Array, seed: int) -> Array:
    """Returns of one episode per sub-environment; ``weights``: (num_envs, observation size)."""
    observations, _ = env.reset(seed=[seed] * env.num_envs)
    returns, done = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
    while not done.all():
        actions = (np.einsum("ij,ij->i", weights, observations) > 0).astype(np.int64)
        observations, rewards, terminations, truncations, _ = env.step(actions)
        returns += rewards * ~done
        done |= terminations | truncations
    return returns


def train(env: Any, rng: np.random.Generator, generations: int = 20) -> tuple[Array, float]:
    """The best weights and their mean return over three episodes."""
    best, best_return, spread = np.zeros(4), -np.inf, 1.0
    for generation in range(generations):
        weights = best + spread * rng.normal(size=(env.num_envs, 4))
        weights[0] = best
        returns = np.mean([play(env, weights, seed) for seed in range(3)], axis=0)
        winner = int(returns.argmax())
        spread *= 0.7 if winner == 0 else 1.0
        best, best_return = weights[winner], float(returns[winner])
        print(f"generation {generation}: best mean return {best_return:.1f}")
        if best_return >= GOOD_ENOUGH:
            break
    return best, best_return


if __name__ == "__main__":
    with make_env(CARTPOLE, n_envs=CANDIDATES) as suites:
        found, value = train(suites.env, np.random.default_rng(0))
    print(f"push right when {np.round(found, 2)} @ observation > 0: {value:.0f} steps upright")

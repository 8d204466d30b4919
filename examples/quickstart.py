"""Run somebody's environment without letting its code into this process.

    python examples/quickstart.py [REFERENCE]

``REFERENCE`` is a hub reference (``org/repo@commit``) or a folder; by default, the cartpole that
lies next to this file.
"""

import sys
from pathlib import Path

import numpy as np

from envhub_sandbox import make_env


def main(reference: str) -> None:
    """Play one episode in each of four sub-environments, with random actions."""
    with make_env(reference, n_envs=4) as suites:
        for suite, tasks in suites.items():
            for task_id, env in tasks.items():
                env.reset(seed=0)
                returns, done = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
                while not done.all():
                    actions = env.action_space.sample()
                    _, rewards, terminations, truncations, _ = env.step(actions)
                    returns += rewards * ~done
                    done |= terminations | truncations
                print(
                    f"{suite}/{task_id}: {env.num_envs} episodes, mean return {returns.mean():.2f}"
                )
        print("its code is still unknown here:", "env" not in sys.modules)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else str(Path(__file__).parent / "cartpole"))

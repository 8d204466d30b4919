"""LeRobot's own ``make_env``, after one call: the repository's code stays out of this process.

python examples/with_lerobot.py [REPOSITORY]            # pip install lerobot
"""

from __future__ import annotations

import sys
from pathlib import Path

try:
    from lerobot.envs.factory import make_env

    from envhub_sandbox.integrations.lerobot import install
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install lerobot") from None

if __name__ == "__main__":
    install()
    reference = sys.argv[1] if len(sys.argv) > 1 else str(Path(__file__).with_name("catch"))
    envs = make_env(reference, n_envs=2)
    for suite, tasks in envs.items():
        for task, env in tasks.items():
            env.reset(seed=0)
            _, reward, *_ = env.step(env.action_space.sample())
            print(f"{suite}, task {task}: rewards {reward.tolist()}")
            env.close()

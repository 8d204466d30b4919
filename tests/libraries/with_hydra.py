"""Options of ``make_env`` from a configuration of Hydra's, whose lists are ``ListConfig``."""

from typing import Any

import gymnasium as gym
from compared import folder, report
from hydra import compose, initialize
from omegaconf import ListConfig

from envhub_sandbox import make_env

STEPS = 100
OPTIONS = [
    "+n_envs=2",
    "+policy.environment=[LANG,TERM]",
    "+policy.readable=[/usr/share]",
    "+limits.processes=32",
    "+timeouts.startup_s=250",
]
REPOSITORY = folder()


def played(sandboxed: bool) -> list[Any]:
    with initialize(version_base=None):
        options = compose(overrides=OPTIONS)
    assert isinstance(options.policy.environment, ListConfig)
    one = lambda: gym.make("CartPole-v1")  # noqa: E731
    env: Any = gym.vector.SyncVectorEnv([one] * options.n_envs)
    if sandboxed:
        env = make_env(REPOSITORY, **options).env
    seen = [env.reset(seed=0)]
    env.action_space.seed(0)
    seen += [env.step(env.action_space.sample()) for _ in range(STEPS)]
    env.close()
    return [(one[:-1]) for one in seen]


if __name__ == "__main__":
    report("hydra", STEPS, played)

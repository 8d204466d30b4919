import gymnasium as gym
import minigrid  # noqa: F401

SUITES = {"empty": [5, 6], "fetch": [5]}
IDS = {"empty": "MiniGrid-Empty-{0}x{0}-v0", "fetch": "MiniGrid-Fetch-{0}x{0}-N2-v0"}


def make_env(n_envs=1, use_async_envs=False):
    def one(suite, size):
        make = lambda: gym.make(IDS[suite].format(size))  # noqa: E731
        return gym.vector.SyncVectorEnv([make] * n_envs)

    return {
        suite: {number: one(suite, size) for number, size in enumerate(sizes)}
        for suite, sizes in SUITES.items()
    }

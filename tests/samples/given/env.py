"""Sub-environments that the caller hands in, as pickled functions."""

import cloudpickle
import gymnasium as gym


class OwnSyncVectorEnv(gym.vector.SyncVectorEnv):
    """A class of the repository's own, so that it is driven through its own ``step``."""


class OwnAsyncVectorEnv(gym.vector.AsyncVectorEnv):
    """The same with processes."""


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, pickled: bytes = b"", subclass: bool = False
) -> gym.vector.VectorEnv:
    env_fns, kwargs = cloudpickle.loads(pickled)
    if subclass:
        return (OwnAsyncVectorEnv if use_async_envs else OwnSyncVectorEnv)(env_fns, **kwargs)
    cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return cls(env_fns, **kwargs)

"""What a vector environment shows its user, made from what the worker declared.

Trust: the manifest is input from the worker.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.transport.values import not_here, spec_of
from envhub_sandbox.vector.actions import ActionReader
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.spaces import OpaqueSpace


def action_reader(manifest: EnvManifest, count: int) -> Callable[[Any], Any]:
    """Checks a batch of so many actions and makes it what the worker takes."""
    single, own = manifest.single_action_space, manifest.own_batch("action_space")
    if isinstance(single, OpaqueSpace):
        return lambda actions: actions
    if own is not None:
        return ActionReader(own, None).read
    return ActionReader(single, count).read


def metadata(manifest: EnvManifest) -> dict[str, Any]:
    """``env.metadata``, with the autoreset mode as Gymnasium's enum where it has one."""
    mode: Any = manifest.autoreset_mode
    if mode is None:
        return dict(manifest.metadata)
    if hasattr(gym.vector, "AutoresetMode"):
        mode = gym.vector.AutoresetMode(mode)
    return {**manifest.metadata, "autoreset_mode": mode}


def spec(manifest: EnvManifest, reference: str) -> EnvSpec | None:
    """``env.spec``, where the repository gave one: its facts, and nothing that makes anything."""
    return spec_of(manifest.spec, reference)


def env_fns(manifest: EnvManifest, reference: str) -> list[Callable[[], NoReturn]]:
    """``env.env_fns``: one for each sub-environment, as many as ``SyncVectorEnv`` was given.

    The functions are in the sandbox; what stands for them here says so when it is called.
    """
    return [partial(not_here, reference=reference)] * manifest.num_envs


def check_mask(mask: Any, num_envs: int) -> None:
    """``SyncVectorEnv.reset``'s checks, in its words."""
    if not isinstance(mask, np.ndarray):
        raise TypeError(f"`options['reset_mask']` must be a numpy array, got {type(mask)}")
    if mask.shape != (num_envs,):
        raise ValueError(
            f"`options['reset_mask']` must have shape `({num_envs},)`, got {mask.shape}"
        )
    if mask.dtype != np.bool_:
        raise TypeError(f"`options['reset_mask']` must have `dtype=np.bool_`, got {mask.dtype}")
    if not np.any(mask):
        raise ValueError(
            "`options['reset_mask']` must contain a boolean array with at least one True value, "
            f"got reset_mask={mask}"
        )

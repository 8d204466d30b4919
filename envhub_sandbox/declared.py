"""What a vector environment shows its user, made from what the worker declared.

Trust: the manifest and generator states are input from the worker.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.actions import ActionReader
from envhub_sandbox.errors import RemoteProtocolError
from envhub_worker.protocol.manifest import EnvManifest
from envhub_worker.protocol.spaces import OpaqueSpace


def action_reader(manifest: EnvManifest) -> Callable[[Any], Any]:
    """Checks a batch of actions and makes it what the worker takes."""
    space = manifest.single_action_space
    if isinstance(space, OpaqueSpace):
        return lambda actions: actions
    return ActionReader(space, manifest.num_envs).read


def metadata(manifest: EnvManifest) -> dict[str, Any]:
    """``env.metadata``, with the autoreset mode as Gymnasium's enum where it has one."""
    mode: Any = manifest.autoreset_mode
    if mode is None:
        return dict(manifest.metadata)
    if hasattr(gym.vector, "AutoresetMode"):
        mode = gym.vector.AutoresetMode(mode)
    return {**manifest.metadata, "autoreset_mode": mode}


def spec(manifest: EnvManifest) -> EnvSpec | None:
    """``env.spec``, where the repository gave one."""
    if manifest.spec is None or type(manifest.spec.get("id")) is not str:
        return None
    try:
        return EnvSpec(**manifest.spec)
    except Exception:  # an id that this Gymnasium cannot read: not worth failing for
        return None


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


_BIT_GENERATORS = {
    kind.__name__: kind
    for kind in (
        np.random.PCG64,
        np.random.PCG64DXSM,
        np.random.MT19937,
        np.random.Philox,
        np.random.SFC64,
    )
}


def generator(state: Any) -> np.random.Generator:
    """A generator in a given state. Trust: the state is input from the worker."""
    kind = _BIT_GENERATORS.get(str(state.get("bit_generator"))) if type(state) is dict else None
    if kind is None:
        raise RemoteProtocolError("the worker sent the state of an unknown random generator")
    bits = kind()
    try:
        bits.state = state
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise RemoteProtocolError(f"the worker sent a broken generator state: {error}") from error
    return np.random.Generator(bits)

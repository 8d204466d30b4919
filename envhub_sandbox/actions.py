"""Actions as the caller has them, made into the batch that the action space asks for.

Arrays, lists, tuples, mappings and torch tensors are taken. Dtypes are kept as they are where
the space could mean them (``float64`` for a ``float32`` Box), because that is what an environment
in this process would see. Followed: ``gymnasium.vector.utils.iterate``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envhub_sandbox.errors import ActionError

_INTEGERS = frozenset("iub")
_NUMBERS = frozenset("fiub")


@singledispatch
def batch_of(space: gym.Space[Any], value: Any, count: int, where: str = "actions") -> Any:
    """A batch of ``count`` members of a *single* action space.

    Args:
        space: The single action space.
        value: What the caller passed to ``step``.
        count: Number of sub-environments.
        where: What to call it in an error.

    Returns:
        Arrays of shape ``(count, *space.shape)``, in dicts and tuples as the space has them.

    Raises:
        ActionError: A wrong shape, dtype or structure.
    """
    try:
        members = tuple(value)
    except TypeError:
        raise ActionError(
            f"{where}: expected {count} members of {space}, got {_named(value)}"
        ) from None
    if len(members) != count:
        raise ActionError(f"{where}: expected {count} members of {space}, got {len(members)}")
    return members


@batch_of.register(spaces.Box)
@batch_of.register(spaces.Discrete)
@batch_of.register(spaces.MultiDiscrete)
@batch_of.register(spaces.MultiBinary)
def _batch_of_arrays(space: gym.Space[Any], value: Any, count: int, where: str = "actions") -> Any:
    array = value if type(value) is np.ndarray else _array(space, value, where)
    shape = (count, *(space.shape or ()))
    dtype = np.dtype(space.dtype)
    kinds = _NUMBERS if dtype.kind == "f" else _INTEGERS
    if array.shape != shape or array.dtype.kind not in kinds:
        raise ActionError(
            f"{where}: expected {dtype} of shape {shape} for {space} in {count} sub-environments, "
            f"got {array.dtype} of shape {array.shape}"
        )
    return array


@batch_of.register(spaces.Dict)
def _batch_of_dicts(space: spaces.Dict, value: Any, count: int, where: str = "actions") -> Any:
    if not isinstance(value, Mapping):
        raise ActionError(f"{where}: expected a mapping for {space}, got {_named(value)}")
    missing = [key for key in space.spaces if key not in value]
    if missing:
        raise ActionError(f"{where}: {missing} missing; the space is {space}")
    return {
        key: batch_of(sub, value[key], count, f"{where}[{key!r}]")
        for key, sub in space.spaces.items()
    }


@batch_of.register(spaces.Tuple)
def _batch_of_tuples(
    space: spaces.Tuple[Any], value: Any, count: int, where: str = "actions"
) -> Any:
    if not isinstance(value, (tuple, list)) or len(value) != len(space.spaces):
        raise ActionError(
            f"{where}: expected a tuple of {len(space.spaces)} batches for {space}, "
            f"got {_named(value)}"
        )
    return tuple(
        batch_of(sub, item, count, f"{where}[{index}]")
        for index, (sub, item) in enumerate(zip(space.spaces, value, strict=True))
    )


def _array(space: gym.Space[Any], value: Any, where: str) -> Any:
    try:
        if hasattr(value, "detach"):  # a torch tensor, possibly on a device or with a gradient
            value = value.detach().cpu()
        return np.asarray(value)
    except Exception as error:
        raise ActionError(f"{where}: {_named(value)} is no batch for {space}: {error}") from error


def _named(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"

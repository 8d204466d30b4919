"""Converts a caller's actions to a batch of the action space, and checks seeds and masks.

Actions may be arrays, lists, tuples, mappings and torch tensors. A dtype that the space accepts is
kept (``float64`` for a ``float32`` Box), because an environment in this process would see it, too.
Followed: ``gymnasium.vector.utils.iterate``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache, singledispatch
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError, Error

from envhub_sandbox.errors import ActionError, ActionTypeError
from envhub_sandbox.session.requests import Bounds, MessageFor
from envhub_sandbox.system.log import warn_caller
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES, BOX_DTYPES, OpaqueSpace

_INTEGERS = frozenset("iub")
_NUMBERS = frozenset("fiub")
_DTYPES = frozenset(BOX_DTYPES.values())
_PYTHONS = {np.dtype(kind): kind for kind in (bool, int, float)}
"""The Python class whose lists become an array of the dtype."""


class UniterableError(ActionTypeError, CustomSpaceError):
    """A scalar in place of a batch of a space without arrays. Gymnasium raises this, too."""


class SeedError(TypeError, Error):
    """A seed that is not a Python integer. Gymnasium's environments refuse it, too."""

    def __init__(self, seed: object) -> None:
        super().__init__(f"Seed must be a python integer, actual type: {type(seed)}: use int(seed)")


@singledispatch
def batch_of(space: gym.Space[Any], value: Any, count: int | None, name: str = "actions") -> Any:
    """Check a batch of ``count`` members of a *single* space; ``count`` None: of a batched space.

    Returns arrays of shape ``(count, *space.shape)``, in the space's dicts and tuples, or lists of
    Python numbers in place of arrays. ``name`` is the batch's name in errors.
    Raises ``ActionError``: a wrong shape, dtype or structure.
    """
    if count is None:
        return value
    try:
        members = tuple(value)
    except TypeError:
        raise UniterableError(
            f"{name}: expected {count} members of {space}, got {_named(value)}"
        ) from None
    if len(members) != count:
        raise ActionError(f"{name}: expected {count} members of {space}, got {len(members)}")
    return members


@batch_of.register(spaces.Box)
@batch_of.register(spaces.Discrete)
@batch_of.register(spaces.MultiDiscrete)
@batch_of.register(spaces.MultiBinary)
def _batch_of_arrays(
    space: gym.Space[Any], value: Any, count: int | None, name: str = "actions"
) -> Any:
    array = value if type(value) is np.ndarray else array_of(space, value, name)
    shape = _shape(space, count)
    dtype = np.dtype(space.dtype)
    # an empty list says nothing about the kind of its numbers
    if array.shape != shape or (array.size and array.dtype.kind not in _kinds_for(space)):
        kind = ActionError if array.shape else ActionTypeError
        of = "all" if count is None else count
        places = f"{of} sub-environment{'' if count == 1 else 's'}"
        raise kind(
            f"{name}: expected {dtype} of shape {shape} for {space} in {places}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    if _is_listed(value, array):
        return list(value)  # an environment in this process would see the caller's own numbers
    if array.dtype in _DTYPES:
        return array
    # the same numbers in a dtype that can be sent: native byte order, at most 64 bits
    wide = array.dtype.itemsize > np.dtype(np.float64).itemsize
    return array.astype(np.float64 if wide else array.dtype.newbyteorder("="))


@batch_of.register(spaces.Dict)
def _batch_of_dicts(
    space: spaces.Dict, value: Any, count: int | None, name: str = "actions"
) -> Any:
    if not isinstance(value, Mapping):
        raise ActionTypeError(f"{name}: expected a mapping for {space}, got {_named(value)}")
    missing = [key for key in space.spaces if key not in value]
    if missing:
        raise ActionError(f"{name}: {missing} missing; the space is {space}")
    return {  # in the caller's order, which a repository's own class sees
        key: batch_of(space[key], item, count, f"{name}[{key!r}]")
        for key, item in value.items()
        if key in space.spaces
    }


@batch_of.register(spaces.Tuple)
def _batch_of_tuples(
    space: spaces.Tuple[Any], value: Any, count: int | None, name: str = "actions"
) -> Any:
    sequence = isinstance(value, (tuple, list))
    if not sequence or len(value) != len(space.spaces):
        kind = ActionError if sequence else ActionTypeError
        raise kind(
            f"{name}: expected a tuple of {len(space.spaces)} batches for {space}, "
            f"got {_named(value)}"
        )
    return tuple(
        batch_of(sub, item, count, f"{name}[{index}]")
        for index, (sub, item) in enumerate(zip(space.spaces, value, strict=True))
    )


def batch_of_one(space: gym.Space[Any], action: Any, name: str = "action") -> Any:
    """A batch of a single action, whose numbers keep their classes. Raises ``ActionError``: an
    array has a wrong shape; ``batch_of`` finds what else is wrong.
    """
    if isinstance(space, spaces.Dict) and isinstance(action, Mapping):
        keys = [key for key in space.spaces if key in action]
        theirs = [key for key in action if key in space.spaces]
        if theirs != keys:
            _tell_order(tuple(theirs), tuple(keys))
        return {key: batch_of_one(space[key], action[key], f"{name}[{key!r}]") for key in keys}
    if isinstance(space, spaces.Tuple) and isinstance(action, (tuple, list)):
        parts = enumerate(zip(space.spaces, action, strict=False))
        batch = tuple(batch_of_one(*part, f"{name}[{index}]") for index, part in parts)
        return batch if len(batch) == len(action) else action
    if type(action) in (bool, int, float):
        return [action]
    if not isinstance(space, ARRAY_SPACES):
        return (action,)
    array = array_of(space, action, name)
    if array.shape != space.shape:
        raise ActionError(
            f"{name}: expected {space.dtype} of shape {space.shape} for {space}, got "
            f"{array.dtype} of shape {array.shape}"
        )
    if type(action) is list:
        return [action]
    return array[None] if array.ndim or isinstance(action, np.generic) else [array]


@lru_cache(maxsize=16)  # once
def _tell_order(theirs: tuple[Any, ...], keys: tuple[Any, ...]) -> None:
    warn_caller(
        f"the action has its keys in the order {[*theirs]}; the environment gets them in the order "
        f"of its space, {[*keys]}, as from a vector environment"
    )


def action_reader(manifest: EnvManifest, count: int) -> Callable[[Any], Any]:
    """A function that checks a batch of ``count`` actions, and returns the batch for the worker.
    Trust: a manifest is input from the worker.
    """
    single, own = manifest.single_action_space, manifest.own_batch("action_space")
    if isinstance(single, OpaqueSpace):
        return lambda actions: actions
    if own is not None:
        return ActionReader(own, None).read
    return ActionReader(single, count).read


class ActionReader:
    """``batch_of`` for one environment, which computes shape and dtypes once."""

    def __init__(self, space: gym.Space[Any], count: int | None) -> None:
        self._space = space
        self._count = count
        self._shape: tuple[int, ...] | None = None
        self._dtypes: frozenset[Any] = frozenset()  # dtypes that need no further look
        if isinstance(space, ARRAY_SPACES):
            self._shape = _shape(space, count)
            kinds = _kinds_for(space)
            self._dtypes = frozenset(dtype for dtype in _DTYPES if dtype.kind in kinds)

    def read(self, actions: Any) -> Any:
        """Check a batch and return it; raises as ``batch_of`` does."""
        if type(actions) is np.ndarray and (
            actions.shape == self._shape and actions.dtype in self._dtypes
        ):
            return actions
        return batch_of(self._space, actions, self._count)


# --- seeds and masks of resets -------------------------------------------------------------------


def seeds_for_all(seed: Any, manifest: EnvManifest) -> Any:
    """A list with a seed or None for each sub-environment, or None if there is no seed."""
    count = manifest.num_envs
    if isinstance(seed, int):
        return [seed + index for index in range(count)] if manifest.shardable else seed
    if seed is None:
        return None
    try:
        each = list(seed)
    except TypeError:
        raise SeedError(seed) from None
    for seed in each:
        if not (seed is None or isinstance(seed, int)):
            raise SeedError(seed)
    if len(each) != count:
        raise ValueError(
            "If seeds are passed as a list the length must match "
            f"num_envs={count} but got length={len(each)}."
        )
    return each


def check_mask(mask: Any, num_envs: int) -> None:
    """Check a reset mask as ``SyncVectorEnv.reset`` does, with the same error texts."""
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


def reset_message(manifest: EnvManifest, seeds: Any, options: Any, mask: Any = None) -> MessageFor:
    """Returns a function that makes the message of a reset for each shard."""
    sliced = manifest.shardable and seeds is not None

    def message(number: int, bounds: Bounds) -> m.Message:  # kept: must not refer to an environment
        start, stop = bounds
        some = seeds[start:stop] if sliced else seeds
        return m.Reset(number, some, options, None if mask is None else mask[start:stop])

    return message


# --- helpers -------------------------------------------------------------------------------------


def _shape(space: gym.Space[Any], count: int | None) -> tuple[int, ...]:
    return tuple(space.shape or ()) if count is None else (count, *(space.shape or ()))


def _is_listed(value: Any, array: Any) -> bool:
    """Whether the value is lists of numbers of one class, equal to ``array.tolist()``, or a list of
    arrays without dimensions.
    """
    if type(value) not in (list, tuple):
        return False
    if {*map(type, value)} == {np.ndarray} and not any(item.ndim for item in value):
        return array.dtype in _DTYPES and {item.dtype for item in value} == {array.dtype}
    kind = _PYTHONS.get(array.dtype)
    if kind is None:
        return False
    for _ in range(array.ndim - 1):
        if any(type(item) is not list for item in value):
            return False
        value = [part for item in value for part in item]
    return all(type(item) is kind for item in value)


def _kinds_for(space: gym.Space[Any]) -> frozenset[str]:
    return _NUMBERS if np.dtype(space.dtype).kind == "f" else _INTEGERS


def array_of(space: gym.Space[Any], value: Any, path: str) -> Any:
    """Numbers as an array. Raises ``ActionError``: numpy makes none of them."""
    try:
        if hasattr(value, "detach"):  # a torch tensor, possibly on a device or with a gradient
            value = value.detach().cpu()
            if str(value.dtype) == "torch.bfloat16":  # numpy does not have it
                value = value.float()
        return np.asarray(value)
    except Exception as error:
        raise ActionError(f"{path}: {_named(value)} is not a batch for {space}: {error}") from error


def _named(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"

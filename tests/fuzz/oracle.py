"""What may come of a lie, said without the code that is being lied to."""

import copy
import pickle
import re
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array


class WrongError(Exception):
    """A lie had an effect that it must not have."""


def demand(fact: object, what: str) -> None:
    """Raises ``WrongError`` unless it is so."""
    if not fact:
        raise WrongError(what)


def fits(space: gym.Space[Any], batch: Any, count: int) -> None:
    """A batch of a declared space is made as Gymnasium makes one."""
    _same_make(space, create_empty_array(space, count), batch, count)


def _same_make(space: Any, model: Any, batch: Any, count: int) -> None:
    if isinstance(model, np.ndarray):
        demand(type(batch) is np.ndarray, f"{type(batch).__name__} where an array belongs")
        demand(batch.dtype == model.dtype, f"dtype {batch.dtype} where {model.dtype} belongs")
        demand(batch.shape == model.shape, f"shape {batch.shape} where {model.shape} belongs")
        demand(batch.flags.writeable and batch.flags.c_contiguous, "an array of somebody else's")
    elif isinstance(space, spaces.Dict):
        demand(type(batch) is dict and list(batch) == list(model), "another mapping")
        for key, part in model.items():
            _same_make(space[key], part, batch[key], count)
    elif isinstance(space, spaces.Tuple):
        demand(type(batch) is tuple and len(batch) == len(model), "another tuple")
        for sub, part, item in zip(space.spaces, model, batch, strict=True):
            _same_make(sub, part, item, count)
    else:
        demand(type(batch) is tuple and len(batch) == count, "not one member each")


def per_env(name: str, column: Any, kinds: str, count: int) -> None:
    """One number, or one boolean, each."""
    demand(type(column) is np.ndarray and column.shape[:1] == (count,), f"{name} is no column")
    demand(column.dtype.kind in kinds, f"{name} of {column.dtype}")
    if column.dtype.kind == "b":
        demand(set(column.tobytes()) <= {0, 1}, f"{name} holds what is no boolean")


def usable(value: Any) -> None:
    """What every program does with what it is given: nothing of it may raise."""
    repr(value)
    copy.deepcopy(value)
    try:
        pickle.dumps(value)
    except RuntimeError as error:  # numpy has arrays of more dimensions than it can pickle
        demand("dimensions" in str(error), repr(error))
    _look(value)


def _look(value: Any) -> None:
    if type(value) is dict:
        for key, item in value.items():
            hash(key)
            _look(item)
    elif type(value) in (list, tuple):
        for item in value:
            _look(item)
    elif isinstance(value, np.ndarray):
        np.array(value)
        if value.dtype.kind == "b":
            demand(set(value.tobytes()) <= {0, 1}, "a boolean that is neither")
        if value.dtype == object:
            for item in value.reshape(-1):
                _look(item)


def alike(one: Any, other: Any) -> bool:
    """Equal, and of the same types all the way down."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray) and one.dtype != object:
        same = one.dtype == other.dtype and one.shape == other.shape
        return same and one.tobytes() == other.tobytes()
    if isinstance(one, np.ndarray):
        return one.shape == other.shape and alike(one.ravel().tolist(), other.ravel().tolist())
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, dict):
        return alike(list(one.items()), list(other.items()))
    if isinstance(one, np.random.Generator):  # whose repr is an address
        return alike(one.bit_generator.state, other.bit_generator.state)
    if isinstance(one, (set, frozenset)):  # of which equal ones may have another order
        return sorted(map(_text, one)) == sorted(map(_text, other))
    return _text(one) == _text(other)


def _text(value: Any) -> str:
    """Its ``repr`` without addresses."""
    return re.sub("0x[0-9A-F]+", "", repr(value))

"""The space that stands for spaces of the peer's own, and what both directions agree on."""

from __future__ import annotations

from typing import Any, NoReturn, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envhub_worker.protocol.codec.arrays import MAX_DIMENSIONS

# A nested space takes two containers of the wire's depth of 32; messages need some around it.
MAX_SPACE_DEPTH = 12

_DTYPE_CODES = ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
BOX_DTYPES = {np.dtype(code).name: np.dtype(code) for code in _DTYPE_CODES}
INTEGER_DTYPES = {name: dtype for name, dtype in BOX_DTYPES.items() if dtype.kind in "iu"}

ARRAY_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
"""Whose members are arrays or numbers, and whose batches are one array."""
FIELDS = {
    "opaque": ("type", "text", "shape", "dtype"),
    "box": ("dtype", "shape", "low", "high", "bounded_below", "bounded_above"),
    "discrete": ("n", "start", "dtype"),
    "multi_discrete": ("dtype", "shape", "nvec", "start"),
    "multi_binary": ("n",),
    "text": ("min_length", "max_length", "characters"),
    "dict": ("keys", "spaces", "sort_keys"),
    "tuple": ("spaces",),
    "one_of": ("spaces",),
    "sequence": ("space", "stack"),
    "graph": ("node", "edge"),
}
"""By the kind of a space: what describes it, beside the kind."""

# Gymnasium 0.29 has none.
OneOf: Any = getattr(spaces, "OneOf", None)


class OpaqueSpace(gym.Space[Any]):
    """Stands for a space of the peer that Gymnasium does not know.

    It can say what it is, be compared and batched, and nothing else.

    Attributes:
        type_name: Qualified class name of the peer's space.
        text: Its ``repr``; bounded and printable.
        dtype_text: Its dtype as text, empty if it has none.
    """

    def __init__(
        self, type_name: str, text: str, shape: tuple[int, ...] | None = None, dtype_text: str = ""
    ) -> None:
        super().__init__(shape=shape)
        self.type_name, self.text, self.dtype_text = type_name, text, dtype_text

    @property
    def is_np_flattenable(self) -> bool:
        """False: nothing is known about its elements."""
        return False

    def sample(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raises ``gymnasium.error.CustomSpaceError``."""
        self._refuse("sample from")

    def contains(self, x: object) -> NoReturn:
        """Raises ``gymnasium.error.CustomSpaceError``."""
        self._refuse("check membership of")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OpaqueSpace) and self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def __repr__(self) -> str:
        return f"OpaqueSpace({self.type_name}: {self.text})"

    def _identity(self) -> tuple[object, ...]:
        return self.type_name, self.text, self.shape, self.dtype_text

    def _refuse(self, what: str) -> NoReturn:
        raise gym.error.CustomSpaceError(
            f"Cannot {what} {self.type_name}: its code exists only inside the sandbox. "
            "Build values for it yourself, or call the environment's own method for it."
        )


def is_shape(value: object) -> TypeGuard[tuple[int, ...]]:
    """Says whether this is a tuple of sizes that numpy can take."""
    return (
        type(value) is tuple
        and len(value) <= MAX_DIMENSIONS
        and all(type(size) is int and 0 <= size < 2**31 for size in value)
    )


def is_charset(characters: str) -> bool:
    """Says whether these are distinct characters that UTF-8 can carry."""
    lone_surrogate = any("\ud800" <= char <= "\udfff" for char in characters)
    return len(set(characters)) == len(characters) and not lone_surrogate

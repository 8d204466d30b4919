"""The layout of the fast lane's shared memory. Pure arithmetic: each side computes it for itself.

Each shard has two slabs. The client writes the *request* slab, which is sealed against the jail's
writes; the jail writes the *reply* slab. Each starts with a header of 64-bit words; polled words
have a cache line of their own. All shards share the *observation* slab and write their rows of the
batch there. It holds one batch, or several in turn (slots), and one batch of rewards and flags.
Arrays lie at 64-byte boundaries. The client never follows an offset or a length that it has not
computed or bounded itself.

::

    request       header | one area per action leaf | a message, encoded
    reply         header | infos, encoded | the answer to a message, encoded
    observations  slot 0: one area per leaf | slot 1 ... | rewards, terminations, truncations

Steps travel in the slabs, and so do small messages in both directions. A step is a message, too, if
the spaces have no fixed layout or the vector environment is the repository's own: its actions lie
in the message area, and its answer fills a slot of an observation slab that belongs to one shard.

Infos travel as columns, without the codec, while each step has the same small dict. If a step's
infos are flat and numeric, both sides derive the same columns from the last *encoded* infos. As
long as later infos have that schema, the jail writes only their numbers. Their masks are all true
and made by the client. Offsets and schemas never come from the jail.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Callable, Iterator
from operator import itemgetter
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from envhub_worker.protocol.codec.arrays import NUMBERS
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.shared_memory.words import *  # noqa: F403 - seen from outside as here
from envhub_worker.protocol.shared_memory.words import HEADER_BYTES, INFO_BYTES, LINE, MAX_LEAVES
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES, BOX_DTYPES

MAX_SLAB_BYTES = 1 << 31
"""Above this the frames lane serves: a slab is pinned memory."""

ACTION_DTYPES = tuple(BOX_DTYPES.values())
"""An action keeps the dtype that the caller gave it; the code is the place in this table."""
LISTED = 32
"""Added to the code, it asks for numbers of Python in lists: the caller gave such. Added twice, it
asks for a list of arrays without dimensions.
"""
DTYPE_CODES = {dtype: code for code, dtype in enumerate(ACTION_DTYPES)}
_ACTION_ITEM_BYTES = 8
_RESULT_BYTES = 8 + 1 + 1
"""A reward and two flags."""
_ENV_INFO_BYTES = 256
"""Room for a sub-environment's results beside its observation, where a step is a message."""

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Leaf:
    """One array of a batched space.

    Attributes:
        path: Keys and indices from the space's root.
        dtype: Of the space.
        shape: ``(count, *shape of a member)``.
        offset: Bytes from the slab's start.
    """

    path: tuple[Any, ...]
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int


@dataclass(frozen=True)
class Layout:
    """The layout of a shard's request slab. All reply slabs have one layout: see ``words``.

    Attributes:
        count: Sub-environments of the shard.
        actions: Leaves of the action space.
        message: Offset of a message.
        request_bytes: Size of the slab.
    """

    count: int
    actions: tuple[Leaf, ...]
    message: int
    request_bytes: int

    @property
    def action_bytes(self) -> int:
        """The bytes that one step sends."""
        return _leaf_bytes(self.actions)


@dataclass(frozen=True)
class ObservationLayout:
    """The layout of the observation slab of all shards: whole batches, one after the other.

    Attributes:
        count: Sub-environments of all shards together.
        leaves: Leaves of the observation space in the first slot.
        slots: Number of batches.
        slot_bytes: Size of one.
        results: Offset of the rewards (float64), the terminations and the truncations (bool).
        total_bytes: Size of the slab.
    """

    count: int
    leaves: tuple[Leaf, ...]
    slots: int
    slot_bytes: int
    results: int
    total_bytes: int

    @property
    def batch_bytes(self) -> int:
        """The bytes of one step's results, without infos."""
        return _leaf_bytes(self.leaves) + self.count * _RESULT_BYTES


def _leaf_bytes(leaves: tuple[Leaf, ...]) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)


def layout_of(action: gym.Space[Any], count: int) -> Layout | None:
    """A shard's layout for a single action space, or None if it has no fixed one."""
    leaves = list(_leaves(action))
    if None in leaves or len(leaves) > MAX_LEAVES:
        return None
    actions, message = _placed(leaves, count, HEADER_BYTES, _ACTION_ITEM_BYTES)
    request_bytes = message + INFO_BYTES
    if request_bytes > MAX_SLAB_BYTES:
        return None
    return Layout(count, actions, message, request_bytes)


def observation_layout(space: gym.Space[Any], count: int, slots: int) -> ObservationLayout | None:
    """The layout for a single observation space, or None if it has no fixed one."""
    leaves = list(_leaves(space))
    if None in leaves or len(leaves) > MAX_LEAVES:
        return None
    placed, slot_bytes = _placed(leaves, count, 0, None)
    if slots > 1:
        slot_bytes = _paged(slot_bytes or 1)  # no map is empty
    results = slot_bytes * slots
    total_bytes = _aligned(results + count * _RESULT_BYTES)
    if total_bytes > MAX_SLAB_BYTES:
        return None
    return ObservationLayout(count, placed, slots, slot_bytes, results, total_bytes)


def message_layout(space: gym.Space[Any], count: int) -> Layout | None:
    """The layout for steps that are messages: room for ``count`` actions of the space."""
    request_bytes = HEADER_BYTES + INFO_BYTES + _message_bytes(space, count)
    return (
        Layout(count, (), HEADER_BYTES, request_bytes) if request_bytes <= MAX_SLAB_BYTES else None
    )


def answer_bytes(space: gym.Space[Any], count: int) -> int:
    """The size of a slot for the answer to a step of ``count`` members of the space.

    It has room for the observation twice (``final_obs``) and for infos. A larger answer goes over
    the server. Pages that are not written cost no memory.
    """
    return _paged(2 * _message_bytes(space, count) + count * _ENV_INFO_BYTES + INFO_BYTES)


def _message_bytes(space: gym.Space[Any], count: int) -> int:
    """Estimates the bytes of ``count`` members, with numbers wider than declared; leaves without a
    fixed layout count as nothing.
    """
    leaves = [leaf for leaf in _leaves(space) if leaf is not None]
    wide = ((1 if dtype.itemsize == 1 else _ACTION_ITEM_BYTES, shape) for _, dtype, shape in leaves)
    return sum(_aligned(count * item_bytes * math.prod(shape)) for item_bytes, shape in wide)


def _paged(size: int) -> int:
    """Rounds a slot's size up to whole pages: the client maps each of several slots on its own."""
    return -(-size // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY


def _leaves(space: gym.Space[Any], path: tuple[Any, ...] = ()) -> Iterator[Any]:
    if isinstance(space, ARRAY_SPACES):
        # in native byte order, in which the client has the space
        yield path, np.dtype(np.dtype(space.dtype).type), tuple(space.shape or ())
    elif isinstance(space, spaces.Dict):
        for key, sub in space.spaces.items():
            yield from _leaves(sub, (*path, key))
    elif isinstance(space, spaces.Tuple):
        for index, sub in enumerate(space.spaces):
            yield from _leaves(sub, (*path, index))
    else:
        yield None


def _placed(
    leaves: list[Any], count: int, start: int, item_bytes: int | None
) -> tuple[tuple[Leaf, ...], int]:
    placed = []
    for path, dtype, shape in leaves:
        placed.append(Leaf(path, dtype, (count, *shape), start))
        start = _aligned(start + count * math.prod(shape) * (item_bytes or dtype.itemsize))
    return tuple(placed), start


def _aligned(offset: int) -> int:
    return -(-offset // LINE) * LINE


def view(buffer: Any, leaf: Leaf, dtype: np.dtype[Any] | None = None, base: int = 0) -> Array:
    """A leaf's array in a mapped slab; ``base`` is the offset of its slot."""
    array: Array = np.ndarray(leaf.shape, dtype or leaf.dtype, buffer, base + leaf.offset)
    return array


def results(buffer: Any, layout: ObservationLayout) -> tuple[Array, Array]:
    """Rewards, float64 ``(count,)``, and the bytes of terminations and truncations."""
    rewards: Array = np.frombuffer(buffer, np.float64, layout.count, layout.results)
    start = layout.results + rewards.nbytes
    flags: Array = np.frombuffer(buffer, np.uint8, 2 * layout.count, start)
    return rewards, flags


def assembler(space: gym.Space[Any]) -> Callable[[list[Any]], Any]:
    """A function that puts a flat list of leaves, in their order, into the space's structure."""
    if isinstance(space, ARRAY_SPACES):
        return itemgetter(0)
    if isinstance(space, spaces.Dict):
        keys = list(space.spaces)
        if all(isinstance(sub, ARRAY_SPACES) for sub in space.spaces.values()):
            return lambda leaves: dict(zip(keys, leaves, strict=True))
    nested = _nested(space)
    return lambda leaves: nested(iter(leaves))


def _nested(space: gym.Space[Any]) -> Callable[[Iterator[Any]], Any]:
    if isinstance(space, spaces.Dict):
        parts = {key: _nested(sub) for key, sub in space.spaces.items()}
        return lambda leaves: {key: part(leaves) for key, part in parts.items()}
    if isinstance(space, spaces.Tuple):
        members = [_nested(sub) for sub in space.spaces]
        return lambda leaves: tuple(member(leaves) for member in members)
    return next


def flatten(space: gym.Space[Any], batch: Any) -> list[Any]:
    """The leaves of a batch in the order of ``Layout``: the inverse of ``assembler``."""
    if isinstance(space, spaces.Dict):
        return [leaf for key, sub in space.spaces.items() for leaf in flatten(sub, batch[key])]
    if isinstance(space, spaces.Tuple):
        pairs = zip(space.spaces, batch, strict=True)
        return [leaf for sub, item in pairs for leaf in flatten(sub, item)]
    return [batch]


MAX_COLUMNS = 256
_KINDS = frozenset("biuf")
_NO_COLUMNS = frozenset({batches.APART_SCALARS, batches.APART_CLASSES})
"""Keys that infos may have beside their columns, whose values stay the same from step to step."""


@dataclass(frozen=True)
class Column:
    """One key's array.

    Attributes:
        key: The key, ``_key`` for a mask.
        dtype: Of the array.
        shape: ``(count, ...)``.
        offset: Bytes from the start of the info area.
    """

    key: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int

    def view(self, buffer: Any, start: int) -> Any:
        """Returns the column as a view of a mapped slab whose info area is at ``start``.

        Booleans are read as bytes: a hostile byte of 2 would be a bool that is neither true nor
        false.
        """
        dtype = np.dtype(np.uint8) if self.dtype.kind == "b" else self.dtype
        return np.ndarray(self.shape, dtype, buffer, start + self.offset)


def columns_of(infos: dict[Any, Any]) -> tuple[Column, ...] | None:
    """Returns the columns of flat, numeric infos in their order; None for other infos."""
    columns: list[Column] = []
    offset = 0
    for key, value in infos.items():
        if type(key) is int and key in _NO_COLUMNS:
            continue
        if type(key) is not str or type(value) is not np.ndarray:
            return None
        if value.dtype.kind not in _KINDS or value.dtype not in NUMBERS:  # sent in another dtype
            return None
        columns.append(Column(key, value.dtype, value.shape, offset))
        offset += -(-math.prod(value.shape) * value.dtype.itemsize // LINE) * LINE
    fits = columns and len(columns) <= MAX_COLUMNS and offset <= INFO_BYTES
    return tuple(columns) if fits else None

"""Infos as columns: the same small dict every step, without a codec.

When a step's infos are flat and numeric, both sides derive the same columns from the last infos
that went *encoded*; as long as the next ones have that schema, only the numbers are written. No
offset and no schema ever comes from the jail.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.shared_memory.slabs import INFO_BYTES, LINE
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.untrusted import FAULTS

MAX_COLUMNS = 256
_KINDS = frozenset("biuf")


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
        """Its place in a mapped slab whose info area is at ``start``.

        Booleans are bytes there: a hostile byte of 2 would make a bool that is neither.
        """
        dtype = np.dtype(np.uint8) if self.dtype.kind == "b" else self.dtype
        return np.ndarray(self.shape, dtype, buffer, start + self.offset)


def own_info(infos: dict[Any, Any]) -> dict[Any, Any] | None:
    """The only one of infos that are not joined; None where there are others, or they are."""
    own = infos.get(0)
    return own if type(own) is dict and not infos.keys() - {0, batches.APART_SCALARS} else None


def columns_of(infos: dict[Any, Any]) -> tuple[Column, ...] | None:
    """The columns of flat, numeric infos in their order; None for any others.

    Of infos that are not joined, those of what joining makes of them.
    """
    columns: list[Column] = []
    if own_info(infos) is not None:
        try:
            infos = batches.join_pairs([(0, infos[0])], 1)
        except FAULTS:
            return None
    offset = 0
    for key, value in infos.items():
        if type(key) is not str or type(value) is not np.ndarray or value.dtype.kind not in _KINDS:
            return None
        columns.append(Column(key, value.dtype, value.shape, offset))
        offset += -(-math.prod(value.shape) * value.dtype.itemsize // LINE) * LINE
    fits = columns and len(columns) <= MAX_COLUMNS and offset <= INFO_BYTES
    return tuple(columns) if fits else None

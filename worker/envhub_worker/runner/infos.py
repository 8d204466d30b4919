"""Joins sub-environments' infos as ``VectorEnv._add_info`` does, and puts them into a slab."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.slabs import Column, columns_of
from envhub_worker.protocol.spaces import batches

Pack = Callable[[m.Message], list[Any]]
Pairs = list[tuple[int, dict[Any, Any]]]
"""Infos with the index of their sub-environment, in the order in which they came."""


def join(pairs: Pairs, count: int, *, sliced: bool = False) -> dict[Any, Any]:
    """The infos of ``count`` sub-environments.

    Args:
        sliced: Whether there are others elsewhere. What does not go together here may do so there,
            where another sub-environment is the first: then they have to be asked for one by one.
    """
    try:
        return batches.join_pairs(pairs, count)
    except Exception:
        if not sliced:
            raise
        return dict(batches.APART)


def apart(pairs: Pairs, integers: Sequence[bool] = ()) -> dict[Any, Any]:
    """The infos of the only sub-environment as it gave them, in their order."""
    infos: dict[Any, Any] = {place: info for place, (_, info) in enumerate(pairs)}
    return {**infos, batches.APART_SCALARS: tuple(integers)} if any(integers) else infos


class InfoWriter:
    """Writes infos into a slab: as columns while their schema stays the same, else encoded.

    Args:
        start: Offset of its info area.
        joined: Joins infos as they are sent.
    """

    def __init__(
        self,
        reply: Any,
        start: int,
        count: int,
        pack: Pack = m.pack,
        *,
        joined: Callable[[Pairs], dict[Any, Any]],
    ) -> None:
        self._reply = reply
        self._start = start
        self._count = count
        self._pack = pack
        self._joined = joined
        self._integers: Sequence[bool] = ()
        self._keys: list[Any] | None = None
        self._types: list[type] = []
        self._rows: list[Any] = []
        self._masks: list[Any] = []
        self._fresh = False

    def write(self, pairs: Pairs, integers: Sequence[bool] = ()) -> tuple[int, int]:
        """The outcome and the length for the reply's header.

        Args:
            integers: What ``joined`` says of the observation; part of the schema.

        Raises:
            ProtocolError: They cannot cross.
        """
        if self._keys is not None and integers == self._integers and self._write_columns(pairs):
            return slabs.COLUMNS, 0
        infos = self._joined(pairs)
        frames = self._pack(m.Value(infos))
        if len(frames) > 1 or memoryview(frames[0]).nbytes > slabs.INFO_BYTES:
            return slabs.FETCH, 0
        self._learn(pairs, infos)
        self._integers = integers
        return slabs.DONE, self.put(frames[0])

    def put(self, frame: Any) -> int:
        """Write encoded bytes; returns their number."""
        size = memoryview(frame).nbytes
        self._fresh = True
        self._reply[self._start : self._start + size] = frame
        return size

    def _write_columns(self, pairs: Pairs) -> bool:
        if len(pairs) != self._count:
            return False
        keys, types, rows = self._keys, self._types, self._rows
        for _, info in pairs:
            if list(info) != keys or list(map(type, info.values())) != types:
                return False
        try:
            for index, info in pairs:
                for row, value in zip(rows, info.values(), strict=True):
                    row[index] = value
        except OverflowError:  # an integer beyond 64 bit: joining fails of it, or it goes encoded
            return False
        if self._fresh:  # the encoded infos lay here
            for mask in self._masks:
                mask[...] = 1
            self._fresh = False
        return True

    def _learn(self, pairs: Pairs, infos: dict[Any, Any]) -> None:
        """Columns are for scalars that every sub-environment has: then all masks are true."""
        self._keys = None
        columns = columns_of(infos)
        first = pairs[0][1] if pairs else {}
        types = list(map(type, first.values()))
        if (
            columns is None
            or len(columns) != 2 * len(first)
            or not all(map(batches.is_scalar, types))
        ):
            return
        by_key = {column.key: column for column in columns}
        self._rows = [self._view(by_key[key]) for key in first]
        self._masks = [self._view(by_key[f"_{key}"]) for key in first]
        self._keys, self._types, self._fresh = list(first), types, True

    def _view(self, column: Column) -> Any:
        return column.view(self._reply, self._start)

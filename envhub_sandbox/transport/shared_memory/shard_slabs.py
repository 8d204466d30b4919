"""One shard's slabs: actions and messages are written, and what a runner wrote is read.

They are shared with the runner (``shard``), or a server has them and sends what it reads of its own
(``served_lane``). Trust: the jail writes the reply slab whenever it likes, so every word is read
once and bounded, and bytes are copied before they are looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.transport.values.descriptions import unpacked
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import Column, columns_of, own_info
from envhub_worker.protocol.stream import read_packet
from envhub_worker.protocol.untrusted import UNTRUSTED

Outcome = tuple[int, m.Message | None]
"""``slabs.DONE``, ``RAISED``, ``FETCH`` or ``COLUMNS``, and what came encoded."""
_OUTCOMES = frozenset({slabs.DONE, slabs.RAISED, slabs.FETCH, slabs.COLUMNS})
_UNKNOWN = -1


class ShardSlabs:
    """The request slab and the reply slab of one shard.

    What is remembered of a slab is forgotten before it is written, and noted again afterwards:
    docs/internals/interruption.md, rule 3.

    Args:
        layout: Where everything lies.
        request: The memory of the request slab.
        reply: The memory of the reply slab.
    """

    def __init__(self, layout: slabs.Layout, request: Any, reply: Any) -> None:
        self.layout = layout
        self._request, self._reply = request, reply
        self._asks = slabs.words(request)
        self._tells = slabs.words(reply)
        self._columns: list[tuple[Column, Any]] = []
        self._own: dict[Any, Any] | None = None
        self._views: dict[tuple[int, Any], Any] = {}
        self._codes = [_UNKNOWN] * len(layout.actions)
        self._wishes: tuple[int, int, int] | None = (0, 0, 0)
        self._told = False

    def write(self, leaves: Sequence[Any], slot: int, spin_ns: int, cpu: int = 0) -> None:
        """Write a shard's actions; its observations are to go to ``slot``."""
        asks = self._asks
        if self._told:
            asks[slabs.MESSAGE] = 0
            self._told = False
        for index, leaf in enumerate(leaves):
            listed = type(leaf) is list
            if listed:
                leaf = np.asarray(leaf)
            found = self._views.get((index, leaf.dtype))
            if found is None:
                found = self._view(index, leaf.dtype)
            code = found[0] + slabs.LISTED if listed else found[0]
            if self._codes[index] != code:
                self._codes[index] = _UNKNOWN
                asks[slabs.DTYPES + index] = code
                asks[slabs.CHANGES] += 1
                self._codes[index] = code
            found[1][...] = leaf
        wishes = (spin_ns, slot, cpu)
        if wishes != self._wishes:
            self._wish(*wishes)

    def write_message(self, packet: bytes, slot: int, spin_ns: int = 0, cpu: int = 0) -> None:
        """Write a message in the place of actions."""
        start = self.layout.message
        self._request[start : start + len(packet)] = packet
        self._told = True
        self._asks[slabs.MESSAGE] = len(packet)
        wishes = (spin_ns, slot, cpu)
        if wishes != self._wishes:
            self._wish(*wishes)

    def _wish(self, spin_ns: int, slot: int, cpu: int) -> None:
        asks = self._asks
        self._wishes = None
        asks[slabs.SPIN] = spin_ns
        asks[slabs.SLOT] = slot
        asks[slabs.CPU] = cpu
        asks[slabs.CHANGES] += 1
        self._wishes = (spin_ns, slot, cpu)

    def _view(self, index: int, dtype: Any) -> tuple[int, Any]:
        code = slabs.DTYPE_CODES[dtype]
        leaf = self.layout.actions[index]
        made = self._views[index, dtype] = (code, slabs.view(self._request, leaf, dtype))
        return made

    @property
    def known(self) -> int:
        """Bytes of infos that the columns take."""
        return self._asks[slabs.KNOWN]

    def has_nothing_to_say(self) -> bool:
        """Whether the reply is results and nothing else."""
        tells = self._tells
        return tells[slabs.OUTCOME] == slabs.DONE and not tells[slabs.LENGTH]

    def outcome(self) -> Outcome:
        """How the request went. Trust: input from the worker; the length is bounded here.

        What came encoded is decoded at once, wanted or not: the columns that follow are its.
        """
        kind, length = self._tells[slabs.OUTCOME], self._tells[slabs.LENGTH]
        if kind not in _OUTCOMES or length > slabs.INFO_BYTES:
            raise RemoteProtocolError("the worker wrote an impossible reply into its slab")
        if not length:
            return kind, None
        start = self.layout.infos
        message = unpacked([self._reply[start : start + length]])
        if isinstance(message, m.Value) and type(message.value) is dict:
            with UNTRUSTED:
                self._learn(message.value)
        return kind, message

    def answer(self) -> m.Message | None:
        """The answer to a message; None if it did not fit. Trust: as ``outcome``."""
        kind, length = self._tells[slabs.OUTCOME], self._tells[slabs.LENGTH]
        if kind == slabs.FETCH:
            return None
        if kind not in (slabs.DONE, slabs.RAISED) or length > slabs.INFO_BYTES:
            raise RemoteProtocolError("the worker wrote an impossible answer into its slab")
        if kind == slabs.RAISED:
            return self.outcome()[1]
        start = self.layout.answer
        with UNTRUSTED:
            packet = read_packet(self._reply[start : start + length])
        return unpacked(packet.frames)

    def _learn(self, infos: dict[Any, Any]) -> None:
        start = self.layout.infos
        columns = columns_of(infos) or ()
        self._columns = [(column, column.view(self._reply, start)) for column in columns]
        self._own = None if own_info(infos) is None else infos
        self._asks[slabs.KNOWN] = max((c.offset + v.nbytes for c, v in self._columns), default=0)

    def columns(self) -> dict[Any, Any]:
        """Infos that came as columns: fresh arrays."""
        if not self._columns:
            raise RemoteProtocolError("the worker sent columns before their schema")
        columns = {column.key: view.astype(column.dtype) for column, view in self._columns}
        if self._own is None:
            return columns
        own = {key: _as(value, columns[key][0]) for key, value in self._own[0].items()}
        return {**self._own, 0: own}

    def close(self) -> None:
        """Give everything back."""
        self._asks.release()
        self._tells.release()
        # the maps go with the last array over them


def _as(known: Any, value: Any) -> Any:
    """A column's value as its schema had one: of Python's class, or numpy's."""
    return value if isinstance(known, (np.generic, np.ndarray)) else value.item()

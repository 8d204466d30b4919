"""Results of a step that is a message, as columns: changed values only, without the codec.

Most steps return the same classes, keys, shapes and dtypes as the step before. Both sides derive
the columns from one encoded message; while later results have that form, only their numbers and
texts are written. No offset, class or key comes from the jail in between.

Arrays, and bits of tensors, have a place each in the slot of the observation slab. Scalars are a
list in msgpack, in the reply slab's area of infos. Members of a space whose sizes vary have sizes
among the scalars, and arrays behind the others (``ragged``); so have arrays of objects
(``final_obs``), which mark where they have None.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Any
from zlib import crc32

import gymnasium as gym
import msgpack  # type: ignore[import-untyped]
import numpy as np
from gymnasium import spaces

from envhub_worker.protocol.codec import arrays
from envhub_worker.protocol.codec.decoder import TensorMaker
from envhub_worker.protocol.errors import UNTRUSTED, RemoteProtocolError
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory import ragged
from envhub_worker.protocol.shared_memory.words import INFO_BYTES, LINE
from envhub_worker.protocol.spaces.batches import APART_CLASSES

_MAX_PARTS = 1024
_PLAIN = frozenset({float, int, bool, str})
_AS_TUPLES = (tuple.__iter__, tuple.__len__)
New = tuple[list[Any], list[Any], list[ragged.Items]]
"""Scalars and arrays of new results, in the order of the columns, and arrays of varying sizes."""
_Take = Callable[[Any, New], None] | None
"""Adds the scalars and arrays of a part; raises ``IrregularError``: it has another form. None for
an array or a tensor, which ``write`` looks at."""
_Make = Callable[[Iterator[Any], Iterator[Any]], Any] | None
"""Makes a part of the next scalars and arrays; None for the next array."""


class StepColumns:
    """The columns of results that have the form of ``values``.

    Args:
        values: The fields of one message.
        room: Bytes of a slot.
        space: The space of one sub-environment's part of the first field, an observation.

    Attributes:
        nbytes: Bytes of a slot that the arrays of fixed sizes take.
        read_bytes: Bytes of the slot that the last ``read`` has read.
        checked: Whether the client has compared the form with what was declared.
        digest: Differs if the peer derives other columns; not 0.
        has_classes: Whether members have the classes that Gymnasium gives them (``GraphInstance``).

    Raises:
        IrregularError: The values are not only numbers, texts, arrays of numbers, tensors, None and
            bytes, in tuples, lists, dicts with text keys and arrays of objects of one form; or are
            too many, or too large.
    """

    def __init__(
        self, values: Sequence[Any], room: int, space: gym.Space[Any] | None = None
    ) -> None:
        self._scalars: list[type] = []  # classes, in the order of the columns
        # Of each array: shape, dtype, offset in a slot, and its tensor's dtype by name, or "".
        self._arrays: list[tuple[tuple[int, ...], np.dtype[Any], int, str]] = []
        self._forms: list[tuple[Any, Any, tuple[int, ...]]] = []  # class, its dtype, shape
        self.nbytes, self._room, self._parts = 0, room, 0
        self._copies: dict[int, list[ragged.Copy]] = {}  # by the slot's start; for reading
        self._views: dict[int, list[Any]] = {}  # likewise, for writing
        self.has_classes, self.checked = True, False
        self._varies = False  # whether it has members of varying sizes
        # Where ``read`` finds arrays of varying sizes; None afterwards, as it refers to the slot.
        self._area: Any = None
        try:
            fields = [self._observed(space, values[0]), *map(self._part, values[1:])]
        except RecursionError as error:
            raise IrregularError from error
        self._takes, self._makes = [take for take, _ in fields], [make for _, make in fields]
        self.read_bytes = self.nbytes
        self.digest = 1 + crc32(repr((self._scalars, self._arrays)).encode())
        named = enumerate(name for _, _, _, name in self._arrays)
        self._tensors = [(index, name) for index, name in named if name]
        groups: dict[str, list[int]] = {}  # tensors without dimensions, by dtype
        for index, name in self._tensors:
            if not self._arrays[index][0]:
                groups.setdefault(name, []).append(index)
        self._groups = list(groups.values())

    # --- deriving the columns ------------------------------------------------------------------

    def _observed(self, space: gym.Space[Any] | None, value: Any) -> tuple[_Take, _Make]:
        """As ``_part``; sizes vary as the space says."""
        if isinstance(space, spaces.Dict) and type(value) is dict:
            if value.keys() == space.spaces.keys():
                parts = [self._observed(space[key], item) for key, item in value.items()]
                return _members(dict, parts, list(value))
        elif isinstance(space, spaces.Tuple) and type(value) is tuple:
            if len(value) == len(space.spaces):
                parts = list(map(self._observed, space.spaces, value))
                return _members(tuple, parts, len(parts))
        elif space is not None and ragged.varies(space) and type(value) is tuple:
            with suppress(IrregularError):
                return self._varying(*ragged.members_of(space), len(value))
            self.has_classes = False
        return self._part(value)

    def _varying(self, write: ragged.Write, read: ragged.Read, count: int) -> tuple[Any, Any]:
        self._scalars += [bytes, str]
        self._varies = True

        def take(value: Any, new: New) -> None:
            numbers, text, varying = ragged.write_members(write, count, value)
            new[0].extend((numbers, text))
            new[2].extend(varying)

        def make(scalars: Iterator[Any], _: Iterator[Any]) -> Any:
            received = ragged.Received(next(scalars), next(scalars), self._area)
            return ragged.read_members(read, count, received)

        return take, make

    def _objects(self, value: Any) -> tuple[_Take, _Make]:
        known = next((member for member in value if member is not None), None)
        count = len(value)
        take, make = self._varying(*ragged.members_like(known, self._count_part), count)

        def take_objects(value: Any, new: New) -> None:
            if type(value) is not np.ndarray or value.dtype != object or value.shape != (count,):
                raise IrregularError
            take(tuple(value.tolist()), new)

        return take_objects, lambda *columns: np.fromiter(make(*columns), object, count)

    def _count_part(self) -> None:
        self._parts += 1
        if self._parts > _MAX_PARTS:
            raise IrregularError

    def _part(self, value: Any) -> tuple[_Take, _Make]:
        self._count_part()
        kind = type(value)
        if kind in _PLAIN:
            return self._scalar(kind, kind, item=False)
        if value is None or kind is bytes:
            return partial(_take_same, value), lambda scalars, found: value
        if kind is dict and {str}.issuperset(map(type, value.keys() - {APART_CLASSES})):
            return _members(kind, [self._part(item) for item in value.values()], list(value))
        # A named tuple crosses as its members, unless it says that it has others.
        named = issubclass(kind, tuple) and (kind.__iter__, kind.__len__) == _AS_TUPLES
        if kind is list or named:
            return _members(kind, [self._part(item) for item in value], len(value))
        return self._leaf(value)

    def _scalar(self, kind: Any, plain: type, item: bool) -> tuple[_Take, _Make]:
        self._scalars.append(plain)
        if plain not in _PLAIN:  # complex
            raise IrregularError
        if item:
            return partial(_take_item, kind), lambda scalars, found: kind(next(scalars))
        return partial(_take_scalar, kind), _next_scalar

    def _leaf(self, value: Any) -> tuple[_Take, _Make]:
        name, array = "", value
        if isinstance(value, np.generic) and value.dtype in arrays.NUMBERS:
            return self._scalar(type(value), type(value.item()), item=True)
        if type(value) is np.ndarray and value.dtype == object and value.ndim == 1:
            return self._objects(value)
        if type(value) is _tensor_type():
            name, array = arrays.tensor_bits(value)
        # without torch bfloat16 arrives as another dtype
        if type(array) is not np.ndarray or array.dtype not in arrays.NUMBERS or name == "bfloat16":
            raise IrregularError
        self._arrays.append((array.shape, array.dtype, self.nbytes, name))
        self._forms.append((type(value), value.dtype, array.shape))
        self.nbytes += -(-array.nbytes // LINE) * LINE
        if self.nbytes > self._room:
            raise IrregularError
        return None, None

    # --- writing and reading -------------------------------------------------------------------

    def write(self, values: Sequence[Any], memory: Any, start: int) -> bytes:
        """Write arrays into the slot at ``start``; returns the scalars, packed.
        Raises ``IrregularError``: these results have another form; nothing was written.
        """
        # All values are looked at before the first is written: a slot never holds half a step.
        new: New = [], [], []
        if len(values) != len(self._takes):
            raise IrregularError
        _take_all(self._takes, values, new)
        for (kind, dtype, shape), array in zip(self._forms, new[1], strict=True):
            if type(array) is not kind or array.dtype != dtype or array.shape != shape:
                raise IrregularError
        for index, _ in self._tensors:
            if self._arrays[index][0]:  # those without dimensions are copied together
                new[1][index] = _bits(new[1][index])
        for group in self._groups:
            bits = _bits_of([new[1][index] for index in group])
            for index, array in zip(group, bits, strict=True):
                new[1][index] = array
        packed = _packed(new[0]) if new[0] else b""
        if new[2]:
            ragged.ArrayArea(memory, start, self._room, self.nbytes).write(new[2])
        views = self._views.get(start)
        if views is None:
            places = [(shape, dtype, start + at) for shape, dtype, at, _ in self._arrays]
            views = self._views[start] = [
                np.ndarray(shape, dtype, memory, offset) for shape, dtype, offset in places
            ]
        for view, array in zip(views, new[1], strict=True):
            view[...] = array
        return packed

    def read(
        self, memory: Any, start: int, packed: bytes, tensors: TensorMaker, slot: Any = None
    ) -> list[Any]:
        """The fields of the message, out of the slot at ``start``. Trust: input from the worker.
        ``slot``: a map of the slot, into which large arrays are views; without it all are copies.
        """
        copies = self._copies.get(start)
        if copies is None:
            copies = self._copies[start] = [
                ragged.copier(memory, start + at, shape, dtype)
                for shape, dtype, at, _ in self._arrays
            ]
        if slot is None:
            found = [copy() for copy in copies]
        else:
            found = [
                np.ndarray(shape, dtype, slot, at) if ragged.is_lent(shape, dtype) else copy()
                for copy, (shape, dtype, at, _) in zip(copies, self._arrays, strict=True)
            ]
        for index, name in self._tensors:
            found[index] = tensors(found[index], name)
        if self._varies:
            self._area = ragged.ArrayArea(memory, start, self._room, self.nbytes, slot)
        scalars: Iterator[Any] = iter(())
        taken = iter(found)
        if not self._scalars and not packed:
            return _made(self._makes, scalars, taken)
        with UNTRUSTED:
            # A list that claims more elements, each list in it again, would take memory for them.
            read = msgpack.unpackb(packed, max_array_len=len(self._scalars), max_map_len=0)
            # The worker fills in values; how many there are and of which classes is known already.
            if type(read) is not list or list(map(type, read)) != self._scalars:
                raise RemoteProtocolError("the worker wrote other scalars than it had announced")
            scalars = iter(read)
            values = _made(self._makes, scalars, taken)
        if self._varies:
            self.read_bytes, self._area = self._area.used, None
        return values


def _take_all(takes: Sequence[_Take], values: Iterable[Any], new: New) -> None:
    for take, value in zip(takes, values, strict=True):
        if take is None:
            new[1].append(value)
        else:
            take(value, new)


def _made(makes: Sequence[_Make], scalars: Iterator[Any], arrays: Iterator[Any]) -> list[Any]:
    return [next(arrays) if make is None else make(scalars, arrays) for make in makes]


def _members(kind: Any, parts: Sequence[tuple[_Take, _Make]], keys: Any) -> tuple[_Take, _Make]:
    takes, makes = [take for take, _ in parts], [make for _, make in parts]
    if not parts and kind in (dict, list, tuple):  # as most infos
        return partial(_take_same, kind()), lambda scalars, arrays: kind()
    simple = bool(parts) and {*makes} == {_next_scalar}
    kinds = [take.args[0] for take in takes if isinstance(take, partial)] if simple else []

    def take(value: Any, new: New) -> None:
        if type(value) is not kind or (list(value) if kind is dict else len(value)) != keys:
            raise IrregularError
        if simple:
            items = [*value.values()] if kind is dict else [*value]
            if [*map(type, items)] != kinds:
                raise IrregularError
            new[0].extend(items)
            return
        _take_all(takes, value.values() if kind is dict else value, new)

    def make(scalars: Iterator[Any], arrays: Iterator[Any]) -> Any:
        members = [*islice(scalars, len(makes))] if simple else _made(makes, scalars, arrays)
        if kind is dict:
            return dict(zip(keys, members, strict=True))
        return members if kind is list else tuple(members)

    return take, make


def _packed(scalars: list[Any]) -> bytes:
    try:
        packed: bytes = msgpack.packb(scalars)
    except (OverflowError, UnicodeEncodeError) as error:
        raise IrregularError from error
    if len(packed) > INFO_BYTES:
        raise IrregularError
    return packed


def _next_scalar(scalars: Iterator[Any], _: Iterator[Any]) -> Any:
    return next(scalars)


def _take_same(known: Any, value: Any, new: New) -> None:
    if type(value) is not type(known) or value != known:
        raise IrregularError


def _take_scalar(kind: Any, value: Any, new: New) -> None:
    if type(value) is not kind:
        raise IrregularError
    new[0].append(value)


def _take_item(kind: Any, value: Any, new: New) -> None:
    if type(value) is not kind:
        raise IrregularError
    new[0].append(value.item())


def _bits_of(tensors: list[Any]) -> list[Any]:
    """The bits of tensors without dimensions, in one copy from their device."""
    if len(tensors) > 1:
        with suppress(RuntimeError):  # each lies on a device of its own
            stacked = _bits(sys.modules["torch"].stack(tensors))
            return [stacked[index, ...] for index in range(len(tensors))]
    return list(map(_bits, tensors))


def _bits(tensor: Any) -> Any:
    try:
        return tensor.numpy()
    except (RuntimeError, TypeError):  # the codec knows more ways
        _, bits = arrays.tensor_bits(tensor)
    if bits is None:
        raise IrregularError
    return bits


def _tensor_type() -> Any:
    return getattr(sys.modules.get("torch"), "Tensor", None)

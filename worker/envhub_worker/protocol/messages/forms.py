"""What the codec has made of a message, kept for the next one of the same outline.

What recurs, such as steps, calls and what a server is asked, is encoded and decoded once: what the
codec has made of a document is kept, when it is met again, as a *form*. The key is the whole
document, or all that it depends on but scalars, so a form says exactly what the codec would say.
The bytes of arrays are no part of a document: they are new each time, and are checked each time.
Forms are few and small: a peer that sends nothing twice gains nothing and costs nothing.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec.decoder import Decoder, TensorMaker
from envhub_worker.protocol.codec.wire import DOCUMENT_BYTES, TUPLE, Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits

if TYPE_CHECKING:
    from envhub_worker.protocol.codec.arrays import Array

MAX_DOCUMENT_BYTES = 1024
_MAX_FORMS = 256
_MAX_ITEMS = 32
_MAX_TEXT = 256
_SCALARS = frozenset({float, int, bool, str})
_CONSTANTS = frozenset({bytes, type(None)})
_FLOAT = struct.Struct(">Bd")

_TUPLE_HEAD = msgpack.ExtType(TUPLE, b"")

K = TypeVar("K")
F = TypeVar("F")
Make = Callable[[list[Any]], Any]
"""Makes a value of the arrays of its message."""


class Forms(Generic[K, F]):
    """Forms by key; one is made when its key is met for the second time.

    Until then there is no more of a key than its hash: most keys of a server come once, with the
    number of a jail or a time in them, and some are large. Two keys of one hash only get forms
    earlier, for a form is kept under the whole key.
    """

    def __init__(self) -> None:
        self._forms: dict[K, F] = {}
        self._once: set[int] = set()
        self.get = self._forms.get

    def met(self, key: K, make: Callable[[], F]) -> None:
        """Take note of a key that has no form, or none that holds.

        The codec has already made the message. So if ``make`` fails, for whatever reason, there is
        no form, and the codec makes the next message of this key too.
        """
        hashed = hash(key)
        if hashed not in self._once and key not in self._forms:
            if len(self._once) >= _MAX_FORMS:
                self._once.clear()
            self._once.add(hashed)
            return
        self._once.discard(hashed)
        try:
            form = make()
        except Exception:
            return
        if len(self._forms) >= _MAX_FORMS:
            self._forms.clear()
        self._forms[key] = form


class Outlined:
    """What the document of some values depends on, and what of them is new each time.

    Attributes:
        key: Classes, keys and shapes; None if they hold anything but constants, scalars, arrays of
            numbers, tensors, and small tuples, lists and dicts.
        scalars: Numbers and short texts, in the order of the document.
        arrays: Arrays, likewise; of tensors, their bits.
    """

    __slots__ = ("arrays", "key", "scalars")

    def __init__(self, values: list[Any]) -> None:
        self.scalars: list[Any] = []
        self.arrays: list[Array] = []
        self.key: tuple[Any, ...] | None = None
        # deep or cyclic: the codec says what is wrong
        with contextlib.suppress(IrregularError, RecursionError):
            self.key = tuple(map(self._outlined, values))

    def _outlined(self, value: Any) -> Any:
        kind = type(value)
        if kind in _SCALARS:
            if (kind is str and len(value) > _MAX_TEXT) or (kind is int and not _fits(value)):
                raise IrregularError
            self.scalars.append(value)
            return kind
        if kind in _CONSTANTS:
            if kind is bytes and len(value) > _MAX_TEXT:
                raise IrregularError
            return kind, value
        if kind is dict and len(value) <= _MAX_ITEMS:
            if set(map(type, value)) - {str}:
                raise IrregularError
            return kind, *[(key, self._outlined(item)) for key, item in value.items()]
        if (kind is tuple or kind is list) and len(value) <= _MAX_ITEMS:
            return kind, *map(self._outlined, value)
        form, array = _codec().outlined(value) if "numpy" in sys.modules else (None, None)
        if form is None:
            raise IrregularError
        if array is None:
            self.scalars.append(value)
        else:
            self.arrays.append(array)
        return form


def _fits(value: int) -> bool:
    return -(1 << 63) <= value < 1 << 64


class Outgoing:
    """The document of messages of one outline.

    Args:
        kind, values: Of one message.
        frames: What the codec has made of it.
        outlined: Its outline.
        limits: For which it was encoded.

    Raises:
        IrregularError: There is no form for it: another would be encoded in another way.
    """

    __slots__ = ("_in_tail", "_pieces", "limits")

    def __init__(
        self,
        kind: int,
        values: list[Any],
        frames: list[Buffer],
        outlined: Outlined,
        limits: WireLimits,
    ) -> None:
        self.limits = limits
        sizes = [array.nbytes for array in outlined.arrays]
        self._in_tail = _codec().in_tail(sizes) if sizes else []
        parts: list[bytes | None] = [msgpack.Packer().pack_array_header(1 + len(values))]
        parts.append(msgpack.packb(kind))
        in_tail = iter(self._in_tail)
        for value in values:
            _write(value, in_tail, parts)
        # None stands for a scalar; what is constant between two of them is one piece
        self._pieces = [
            piece
            for is_scalar, some in itertools.groupby(parts, key=lambda part: part is None)
            for piece in (some if is_scalar else [b"".join(filter(None, some))])
        ]
        document = self._document(outlined.scalars)
        header = len(document) + sum(itertools.compress(sizes, self._in_tail))
        made = header, self._in_tail.count(False)
        if not bytes(frames[0]).startswith(document) or made != (len(frames[0]), len(frames) - 1):
            raise IrregularError

    def _document(self, scalars: Sequence[Any]) -> bytes:
        new = map(_packed, scalars)
        document = b"".join([next(new) if piece is None else piece for piece in self._pieces])
        return DOCUMENT_BYTES.pack(len(document)) + document

    def frames(self, outlined: Outlined) -> list[Buffer]:
        """The frames of a message of the same outline.
        Raises ``UnicodeEncodeError``: a text is none that the wire has.
        """
        header, frames = [self._document(outlined.scalars)], []
        for array, in_tail in zip(outlined.arrays, self._in_tail, strict=True):
            if in_tail:
                header.append(array.tobytes())
            else:
                frames.append(_codec().raw(array))
        return [b"".join(header), *frames]


def _write(value: Any, in_tail: Iterator[bool], parts: list[bytes | None]) -> None:
    """Add the document of a value that has an outline; None stands for each scalar."""
    kind = type(value)
    packer = msgpack.Packer(default=_unknown)
    if kind in _SCALARS:
        parts.append(None)
    elif kind is dict:
        parts.append(packer.pack_map_header(len(value)))
        for key, item in value.items():
            parts.append(packer.pack(key))
            _write(item, in_tail, parts)
    elif kind is tuple or kind is list:
        head = packer.pack(_TUPLE_HEAD) if kind is tuple else b""
        parts += [packer.pack_array_header(len(value) + bool(head)), head]
        for item in value:
            _write(item, in_tail, parts)
    elif kind in _CONSTANTS:
        parts.append(packer.pack(value))
    else:
        parts.append(_codec().written(value, in_tail))


def _unknown(value: object) -> Any:
    raise IrregularError


def _packed(value: Any) -> bytes:
    kind = type(value)
    if kind is float:
        return _FLOAT.pack(0xCB, value)
    packed: bytes = msgpack.packb(value if kind in _SCALARS else _codec().scalar(value))
    return packed


class Incoming(Generic[F]):
    """What to make of a document that was decoded before.

    Args:
        document: All of it.
        tail, buffers: The bytes of its arrays, of ``split_frames``.
        make: The class of the message.
        limits: For which it was decoded, and holds.

    Raises:
        Exception: There is no form for it: it holds more than constants, tuples, lists, dicts,
            arrays of numbers and tensors.
    """

    __slots__ = ("_arrays", "_fields", "_make", "_message", "limits")

    def __init__(
        self,
        document: bytes,
        tail: Buffer,
        buffers: Sequence[Buffer],
        make: Callable[..., F],
        limits: WireLimits,
    ) -> None:
        self.limits = limits
        self._make = make
        decoder = Decoder(tail, buffers, limits, None, _Tensor, borrows=True)
        notes: list[tuple[Array, bytes]] = []
        decoder.notes = notes
        value: Any = decoder.value(document)
        self._arrays: list[tuple[Any, str | None]] = []
        fields = value[1:]
        self._fields = _maker(tuple(fields), iter(notes), self._arrays)
        if len(self._arrays) != len(notes):
            raise IrregularError
        self._message = make(*fields) if self._fields is None else None

    def message(
        self,
        tail: Buffer = b"",
        buffers: Sequence[Buffer] = (),
        tensors: TensorMaker | None = None,
        *,
        borrows: bool = False,
    ) -> F:
        """The message; what of it can be changed is fresh. Trust: input from the other side.
        ``borrows``: as ``ArrayReader`` has it.
        """
        if not self._arrays and (tail or buffers):
            raise RemoteProtocolError("The message has array bytes that nothing describes.")
        if self._fields is None:
            assert self._message is not None
            return self._message
        arrays: list[Any] = []
        if self._arrays:
            codec = _codec()
            reader = codec.ArrayReader(tail, buffers, self.limits, borrows=borrows)
            for described, tensor in self._arrays:
                array = reader.read(*described)
                arrays.append(array if tensor is None else codec.tensor(array, tensor, tensors))
            reader.finish()
        return self._make(*self._fields(arrays))


class IrregularError(Exception):
    """A value, or a document, that no form can be made of."""


class _Tensor:
    """Stands for a tensor while a form is made."""

    def __init__(self, array: Array, name: str) -> None:
        self.array, self.name = array, name


def _maker(value: Any, notes: Any, arrays: list[tuple[Any, str | None]]) -> Make | None:
    """Makes a fresh value like this one; None where it cannot be changed.

    Args:
        notes: The arrays of the document that have not been met yet, with what describes each.
        arrays: To which those that are met are added, and of what a tensor is made.
    """
    kind = type(value)
    if kind in _CONSTANTS or kind in _SCALARS:
        return None
    if kind is dict and not set(map(type, value)) - {str}:
        named = [(key, *_part(item, notes, arrays)) for key, item in value.items()]
        return lambda new: {key: make(new) if make else item for key, item, make in named}
    if kind is not tuple and kind is not list:
        return _array_maker(value, notes, arrays)
    parts = [_part(item, notes, arrays) for item in value]
    if kind is list:
        return lambda new: [make(new) if make else item for item, make in parts]
    if all(make is None for _, make in parts):
        return None
    return lambda new: tuple([make(new) if make else item for item, make in parts])


def _part(item: Any, notes: Any, arrays: list[tuple[Any, str | None]]) -> tuple[Any, Make | None]:
    """A constant and None, or None and a maker of fresh values: no form keeps an array."""
    make = _maker(item, notes, arrays)
    return (item if make is None else None), make


def _array_maker(value: Any, notes: Any, arrays: list[tuple[Any, str | None]]) -> Make:
    name = value.name if type(value) is _Tensor else None
    array, descriptor = next(notes, (None, b""))
    if array is None or array is not (value if name is None else value.array):
        raise IrregularError
    index = len(arrays)
    arrays.append((_codec().parse_descriptor(descriptor), name))
    return lambda new: new[index]


@cache
def _codec() -> Any:
    from envhub_worker.protocol.codec import arrays

    return arrays

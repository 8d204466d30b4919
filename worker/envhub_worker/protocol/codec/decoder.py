"""One msgpack document, and the bytes of its arrays, to a value. No numpy until an array comes."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import accumulate
from operator import mul
from typing import TYPE_CHECKING, Any

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec import wire
from envhub_worker.protocol.codec.inert import (
    MAX_NAME_CHARS,
    MAX_REPR_CHARS,
    RemoteEnum,
    RemoteObject,
    inert_copy,
    one_line,
)
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import EnvHubError, MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits

if TYPE_CHECKING:
    from envhub_worker.protocol.codec.arrays import Array, ArrayReader

Unpickler = Callable[[Buffer], object]
TensorMaker = Callable[["Array", str], object]
ThingReader = Callable[[WireLimits], Callable[[int, object], object]]
"""Begins the reading of one message: makes what makes a thing of its code and its description."""

# Maps and sets up to this size are too small for colliding keys to cost anything.
_FEW_KEYS = 64
_MAX_SAME_HASH = 16
_DESCRIBED = frozenset({RemoteObject, RemoteEnum})
_LOSSY = _DESCRIBED | {tuple, frozenset, slice}
"""Keys that arrive as these may be equal although the peer's were not, or be unhashable."""


class _Head:
    """The first element of a msgpack array: it says what value the other elements make."""

    __slots__ = ("code", "payload")

    def __init__(self, code: int, payload: bytes) -> None:
        self.code, self.payload = code, payload


class Decoder:
    """Rebuilds one value; msgpack calls its hooks in the order of the document.

    Trust: input from the worker. Sizes are checked before anything is allocated, every byte
    must be accounted for, and nothing is executed.

    Args:
        tail, buffers: Of ``split_frames``.
        limits: What is accepted.
        unpickler: Decodes pickled objects; only a worker, which trusts its client, has one.
        tensors: Makes a tensor of an array and a dtype name (``"bfloat16"`` comes as uint16
            bits). Without it tensors come as arrays, bfloat16 as float32.
        things: Makes described objects (spaces, specs, generators). Decoders without it refuse
            descriptions.
        borrows: As for ``ArrayReader``. Described objects are made of copies all the same.

    Attributes:
        notes: A list that each array and its descriptor are added to, or None.
    """

    __slots__ = (
        *("_arrays", "_borrows", "_buffers", "_empty_rows", "_hashed_keys", "_heads", "_make"),
        "_tail",
        *("limits", "notes", "tensors", "things", "unpickler"),
    )

    def __init__(
        self,
        tail: Buffer,
        buffers: Sequence[Buffer],
        limits: WireLimits,
        unpickler: Unpickler | None,
        tensors: TensorMaker | None,
        things: ThingReader | None = None,
        *,
        borrows: bool = False,
    ) -> None:
        self._borrows = borrows
        self._tail, self._buffers, self.limits = tail, buffers, limits
        self.unpickler, self.tensors, self.things = unpickler, tensors, things
        self._arrays: ArrayReader | None = None  # made for the first array of the message
        self._make: Callable[[int, object], object] | None = None
        self._heads = 0  # without their array yet
        self._hashed_keys = self._empty_rows = 0  # so far
        self.notes: list[tuple[Array, bytes]] | None = None

    def value(self, document: bytes) -> object:
        """Decodes a document. Trust: input from the other side.

        Raises:
            MessageTooLargeError: The message exceeds a limit.
            RemoteProtocolError: The message is malformed.
        """
        wire.check_document(document, self.limits)
        try:
            value = msgpack.unpackb(
                document,
                ext_hook=self._extension,
                list_hook=self._list,
                object_pairs_hook=self._map,
                strict_map_key=False,
            )
        except EnvHubError:
            raise
        except MemoryError as error:
            raise MessageTooLargeError("There is not enough memory to decode it.") from error
        except Exception as error:
            # msgpack and numpy raise many types, and comparing hostile keys may raise any other.
            raise RemoteProtocolError(f"The header cannot be decoded: {error}") from error
        if self._heads:
            raise RemoteProtocolError("An extension is not the first element of its array.")
        if self._arrays is not None:
            self._arrays.finish()
        elif self._tail or self._buffers:
            raise RemoteProtocolError("The message has array bytes that nothing describes.")
        return value

    def _extension(self, code: int, payload: bytes) -> object:
        read = _READERS.get(code)
        if read is not None:
            return read(self, payload)
        if code not in _BUILDERS:
            raise RemoteProtocolError(f"Unknown extension {code}.")
        if payload and code not in (wire.OBJECTS, wire.TENSOR):
            raise RemoteProtocolError(f"Extension {code} has a payload.")
        self._heads += 1
        return _Head(code, payload)

    def _list(self, items: list[Any]) -> object:
        if not items or items[0].__class__ is not _Head:
            return items
        # A head that is still counted when the document ends stood in a wrong place.
        self._heads -= 1
        head = items.pop(0)
        return _BUILDERS[head.code](self, head, items)

    def _map(self, pairs: list[tuple[Any, Any]]) -> object:
        if len(pairs) > _FEW_KEYS:
            self.check_keys([key for key, _ in pairs])
        try:
            result = dict(pairs)
        except TypeError:
            result = {}
        if len(result) != len(pairs):
            keys = _distinct([key for key, _ in pairs])
            result = dict(zip(keys, [value for _, value in pairs], strict=True))
        if len(result) != len(pairs):
            raise RemoteProtocolError("A map has a key twice.")
        return result

    def take(self, descriptor: bytes) -> Array:
        """Returns the next array."""
        if self._arrays is None:
            from envhub_worker.protocol.codec.arrays import ArrayReader

            reader = ArrayReader(self._tail, self._buffers, self.limits, borrows=self._borrows)
            self._arrays = reader
        array = self._arrays.take(descriptor)
        if not array.size:
            self.count_rows(array.shape)
        if self.notes is not None:
            self.notes.append((array, descriptor))
        return array

    def make(self, head: _Head, items: list[Any]) -> object:
        """Makes a described object. All descriptions of one message share a budget."""
        if self.things is None or len(items) != 1:
            raise RemoteProtocolError("The message describes an object of a kind not made here.")
        if self._make is None:
            self._make = self.things(self.limits)
        return self._make(head.code, _owned(items[0]) if self._borrows else items[0])

    def count_rows(self, shape: tuple[int, ...]) -> None:
        """Bound the rows of arrays without elements, which take no bytes: ``tolist`` makes a list
        of each, and a loop has a turn for each.
        """
        self._empty_rows += sum(accumulate(shape[: shape.index(0)], mul))
        if self._empty_rows > self.limits.items:
            raise MessageTooLargeError(
                f"Arrays without elements have more than {self.limits.items} rows (items)."
            )

    def check_keys(self, keys: list[Any]) -> None:
        """Refuses keys chosen to collide, which would make a dict or set take quadratic time."""
        hashed = [key for key in keys if key.__class__ is not str]
        self._hashed_keys += len(hashed)
        if self._hashed_keys > self.limits.hashed_keys:
            raise MessageTooLargeError(
                f"More than {self.limits.hashed_keys} keys that are not text (hashed_keys)."
            )
        # A description hashes its texts, which Python randomises; equal descriptions cost nothing.
        chosen = [hash(key) for key in hashed if key.__class__ not in _DESCRIBED]
        same = Counter(chosen).most_common(1)
        if same and same[0][1] > _MAX_SAME_HASH:
            raise RemoteProtocolError("Keys were chosen so that their hashes collide.")


def _owned(value: Any) -> Any:
    """The value with copies of its arrays, so that the peer cannot change them after a check."""
    if type(value) is dict:
        return {key: _owned(item) for key, item in value.items()}
    if type(value) is list or type(value) is tuple:
        return type(value)(map(_owned, value))
    return value.copy() if hasattr(value, "dtype") else value


def _distinct(keys: list[Any]) -> list[Any]:
    """Returns the keys; a numbered ``RemoteObject`` replaces each unhashable or duplicate key.

    In the worker they were different objects: two with the same ``repr``, or a tensor.
    """
    seen: Counter[object] = Counter()
    elements = []
    lossy = _LOSSY | {getattr(sys.modules.get("numpy"), "ndarray", tuple)}
    for key in keys:
        if key.__class__ in lossy:
            try:
                hash(key)
            except TypeError:
                key = inert_copy(key)
            seen[key] += 1
            if seen[key] > 1:
                same = key if isinstance(key, RemoteObject) else inert_copy(key)
                key = RemoteObject(same.type_name, f"{same.text} #{seen[key]}")
        elements.append(key)
    return elements


def _read_scalar(decoder: Decoder, payload: bytes) -> object:
    from envhub_worker.protocol.codec.arrays import read_numpy_scalar

    return read_numpy_scalar(payload)


def _read_integer(decoder: Decoder, payload: bytes) -> object:
    if len(payload) > decoder.limits.int_bytes:
        raise MessageTooLargeError(
            f"An integer of {len(payload)} bytes is over {decoder.limits.int_bytes} (int_bytes)."
        )
    return int.from_bytes(payload, "little", signed=True)


def _read_complex(decoder: Decoder, payload: bytes) -> object:
    if len(payload) != wire.COMPLEX_BYTES.size:
        raise RemoteProtocolError("A complex number does not have 16 bytes.")
    return complex(*wire.COMPLEX_BYTES.unpack(payload))


def _read_pickle_frame(decoder: Decoder, payload: bytes) -> object:
    if decoder.unpickler is None:
        return _read_pickle(decoder, b"")
    data = decoder.take(payload)
    if data.dtype.name != "uint8" or data.ndim != 1:
        raise RemoteProtocolError("A pickled object is not an array of bytes.")
    return _read_pickle(decoder, data.data)


def _read_pickle(decoder: Decoder, payload: Buffer) -> object:
    if decoder.unpickler is None:
        raise RemoteProtocolError("The message holds a pickled object, which is never loaded.")
    try:
        return decoder.unpickler(payload)
    except ModuleNotFoundError as error:
        raise RemoteProtocolError(
            f"An object of the client cannot be loaded: {error}. The module is not installed where "
            "the environment runs. Pass plain data, or send the module's code along: "
            f"cloudpickle.register_pickle_by_value({error.name})"
        ) from error
    except Exception as error:
        raise RemoteProtocolError(f"An object of the client cannot be loaded: {error}") from error


def _build_set(decoder: Decoder, head: _Head, items: list[Any]) -> set[object]:
    if len(items) > _FEW_KEYS:
        decoder.check_keys(items)
    try:
        result = set(items)
    except TypeError:
        result = set()
    if len(result) != len(items):
        result = set(_distinct(items))
    if len(result) != len(items):
        raise RemoteProtocolError("A set has an element twice.")
    return result


def _build_tuple(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    return tuple(items)


def _build_frozenset(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    return frozenset(_build_set(decoder, head, items))


def _build_range(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    if [type(item) for item in items] != [int, int, int] or not items[2]:
        raise RemoteProtocolError("A range is not made of three integers.")
    return range(*items)


def _build_slice(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    if len(items) != 3:
        raise RemoteProtocolError("A slice does not have three parts.")
    return slice(*items)


def _build_of_numpy(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    from envhub_worker.protocol.codec import arrays

    value: Any = arrays.BUILDERS[head.code](head.payload, items, decoder.tensors)
    if head.code == wire.OBJECTS and not value.size:
        decoder.count_rows(value.shape)
    return value


def _build_enum(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    if len(items) != 3:
        raise RemoteProtocolError("An enumeration's member does not have three parts.")
    return RemoteEnum(*_inert_texts(items[:2]), items[2])


def _build_remote(decoder: Decoder, head: _Head, items: list[Any]) -> object:
    return RemoteObject(*_inert_texts(items))


def _inert_texts(items: list[Any]) -> tuple[str, str]:
    if [type(item) for item in items] != [str, str]:
        raise RemoteProtocolError("A remote object is not made of two texts.")
    return one_line(items[0], MAX_NAME_CHARS), one_line(items[1], MAX_REPR_CHARS)


_READERS: dict[int, Callable[[Decoder, bytes], object]] = {
    wire.ARRAY: Decoder.take,
    wire.SCALAR: _read_scalar,
    wire.INTEGER: _read_integer,
    wire.COMPLEX: _read_complex,
    wire.PICKLE: _read_pickle,
    wire.PICKLE_FRAME: _read_pickle_frame,
}
_BUILDERS: dict[int, Callable[[Decoder, _Head, list[Any]], object]] = {
    wire.TUPLE: _build_tuple,
    wire.SET: _build_set,
    wire.FROZENSET: _build_frozenset,
    wire.RANGE: _build_range,
    wire.SLICE: _build_slice,
    **dict.fromkeys((wire.OBJECTS, wire.TEXT_SCALAR, wire.TENSOR), _build_of_numpy),
    wire.ENUM: _build_enum,
    wire.REMOTE: _build_remote,
    **dict.fromkeys((wire.SPACE, wire.SPEC, wire.GENERATOR), Decoder.make),
}

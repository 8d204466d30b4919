"""One checked msgpack document, and the bytes of its arrays, to a value."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np

from envhub_worker.protocol.codec.arrays import (
    Array,
    ArrayReader,
    read_scalar,
    unpack_shape,
)
from envhub_worker.protocol.codec.inert import (
    MAX_NAME_CHARS,
    MAX_REPR_CHARS,
    RemoteEnum,
    RemoteObject,
    describe,
    one_line,
)
from envhub_worker.protocol.codec.kinds import (
    ARRAY,
    COMPLEX,
    COMPLEX_BYTES,
    ENUM,
    FROZENSET,
    GENERATOR,
    INTEGER,
    OBJECTS,
    PICKLE,
    PICKLE_FRAME,
    RANGE,
    REMOTE,
    SCALAR,
    SET,
    SLICE,
    SPACE,
    SPEC,
    TENSOR,
    TENSOR_DTYPES,
    TEXT_SCALAR,
    TUPLE,
    Buffer,
)
from envhub_worker.protocol.errors import MessageTooLargeError, ProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits

Unpickler = Callable[[Buffer], object]
TensorMaker = Callable[[Array, str], object]
ThingReader = Callable[[WireLimits], Callable[[int, object], object]]
"""Begins the reading of one message: makes what makes a thing of its code and its description."""

# Maps and sets up to this size are too small for colliding keys to cost anything.
_FEW_KEYS = 64
_MAX_SAME_HASH = 16
_DESCRIBED = frozenset({RemoteObject, RemoteEnum})
_LOSSY = _DESCRIBED | {tuple, frozenset, slice, np.ndarray}
"""Classes that keys of different objects arrive as, or that Python cannot hash."""


class _Head:
    """What stands first in a msgpack array and says what the array makes."""

    __slots__ = ("code", "payload")

    def __init__(self, code: int, payload: bytes) -> None:
        self.code, self.payload = code, payload


class Decoder:
    """Rebuilds one value; msgpack calls its hooks in the order of the document."""

    __slots__ = (
        *("_hashed_keys", "_heads", "_make", "limits", "reader", "tensors", "things", "unpickler"),
    )

    def __init__(
        self,
        reader: ArrayReader,
        limits: WireLimits,
        unpickler: Unpickler | None,
        tensors: TensorMaker | None,
        things: ThingReader | None = None,
    ) -> None:
        self.reader, self.limits = reader, limits
        self.unpickler, self.tensors, self.things = unpickler, tensors, things
        self._make: Callable[[int, object], object] | None = None
        self._heads = self._hashed_keys = 0

    def value(self, document: bytes) -> object:
        """Decodes a document that ``structure.check`` let through.

        Raises:
            MessageTooLargeError: Over a limit that only decoding can tell.
            RemoteProtocolError: Malformed in any way.
        """
        try:
            value = msgpack.unpackb(
                document,
                ext_hook=self._extension,
                list_hook=self._list,
                object_pairs_hook=self._map,
                strict_map_key=False,
            )
        except ProtocolError:
            raise
        except MemoryError as error:
            raise MessageTooLargeError("There is not enough memory to decode it.") from error
        except Exception as error:
            # msgpack and numpy refuse in many ways, and hostile keys compare in many more.
            raise RemoteProtocolError(f"The header cannot be decoded: {error}") from error
        if self._heads:
            raise RemoteProtocolError("An extension that heads an array stands elsewhere.")
        return value

    def _extension(self, code: int, payload: bytes) -> object:
        read = _READERS.get(code)
        if read is not None:
            return read(self, payload)
        if code not in _BUILDERS:
            raise RemoteProtocolError(f"Unknown extension {code}.")
        if payload and code not in (OBJECTS, TENSOR):
            raise RemoteProtocolError(f"Extension {code} has a payload.")
        self._heads += 1
        return _Head(code, payload)

    def _list(self, items: list[Any]) -> object:
        if not items or items[0].__class__ is not _Head:
            return items
        # A head that is still counted when the document ends stood in a wrong place.
        self._heads -= 1
        head = items.pop(0)
        return _BUILDERS[head.code](self, items, head.payload)

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

    def make(self, code: int, items: list[Any]) -> object:
        """What is described; all of one message share a budget."""
        if self.things is None or len(items) != 1:
            raise RemoteProtocolError("The message describes what is not made here.")
        if self._make is None:
            self._make = self.things(self.limits)
        return self._make(code, items[0])

    def check_keys(self, keys: list[Any]) -> None:
        """Refuses keys chosen to collide, which would make a dict or set take quadratic time."""
        hashed = [key for key in keys if key.__class__ is not str]
        self._hashed_keys += len(hashed)
        if self._hashed_keys > self.limits.hashed_keys:
            raise MessageTooLargeError(
                f"More than {self.limits.hashed_keys} keys that are no text (hashed_keys)."
            )
        # a description's hash is that of its texts, and equal ones cost nothing
        chosen = [hash(key) for key in hashed if key.__class__ not in _DESCRIBED]
        same = Counter(chosen).most_common(1)
        if same and same[0][1] > _MAX_SAME_HASH:
            raise RemoteProtocolError("Keys were chosen so that their hashes collide.")


def _distinct(keys: list[Any]) -> list[Any]:
    """The same keys, but those that cannot be told apart or hashed here are described.

    In the worker they were different objects: two with the same ``repr``, or a tensor.
    """
    seen: Counter[object] = Counter()
    made = []
    for key in keys:
        if key.__class__ in _LOSSY:
            key = key if _is_hashable(key) else describe(key)
            seen[key] += 1
            if seen[key] > 1:
                same = key if isinstance(key, RemoteObject) else describe(key)
                key = RemoteObject(same.type_name, f"{same.text} #{seen[key]}")
        made.append(key)
    return made


def _is_hashable(key: object) -> bool:
    try:
        hash(key)
    except TypeError:
        return False
    return True


def _read_array(decoder: Decoder, payload: bytes) -> object:
    return decoder.reader.take(payload)


def _read_scalar(decoder: Decoder, payload: bytes) -> object:
    return read_scalar(payload)


def _read_integer(decoder: Decoder, payload: bytes) -> object:
    if len(payload) > decoder.limits.int_bytes:
        raise MessageTooLargeError(
            f"An integer of {len(payload)} bytes is over {decoder.limits.int_bytes} (int_bytes)."
        )
    return int.from_bytes(payload, "little", signed=True)


def _read_complex(decoder: Decoder, payload: bytes) -> object:
    if len(payload) != COMPLEX_BYTES.size:
        raise RemoteProtocolError("A complex number does not have 16 bytes.")
    return complex(*COMPLEX_BYTES.unpack(payload))


def _read_pickle_frame(decoder: Decoder, payload: bytes) -> object:
    if decoder.unpickler is None:
        return _read_pickle(decoder, b"")
    data = decoder.reader.take(payload)
    if data.dtype != np.uint8 or data.ndim != 1:
        raise RemoteProtocolError("A pickled object is not an array of bytes.")
    return _read_pickle(decoder, data.data)


def _read_pickle(decoder: Decoder, payload: Buffer) -> object:
    if decoder.unpickler is None:
        raise RemoteProtocolError("The message holds a pickled object, which is never loaded.")
    try:
        return decoder.unpickler(payload)
    except ModuleNotFoundError as error:
        raise RemoteProtocolError(
            f"An object of the client cannot be loaded: {error}. There is no such module "
            "where the environment runs. Hand over plain data, or have the module's code travel "
            f"along: cloudpickle.register_pickle_by_value({error.name})"
        ) from error
    except Exception as error:
        raise RemoteProtocolError(f"An object of the client cannot be loaded: {error}") from error


def _build_tuple(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    return tuple(items)


def _build_set(decoder: Decoder, items: list[Any], payload: bytes) -> set[object]:
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


def _build_frozenset(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    return frozenset(_build_set(decoder, items, payload))


def _build_range(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    if [type(item) for item in items] != [int, int, int] or not items[2]:
        raise RemoteProtocolError("A range is not made of three integers.")
    return range(*items)


def _build_slice(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    if len(items) != 3:
        raise RemoteProtocolError("A slice does not have three parts.")
    return slice(*items)


def _build_objects(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    shape = unpack_shape(payload)
    if math.prod(shape) != len(items):
        raise RemoteProtocolError("An object array does not have as many elements as its shape.")
    if not items:
        return np.empty(shape, dtype=object)
    array = np.empty(len(items), dtype=object)
    # One by one: numpy would take apart elements that are sequences.
    for index, item in enumerate(items):
        array[index] = item
    return array.reshape(shape)


def _build_text_scalar(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    if len(items) == 1 and type(items[0]) is str:
        return np.str_(items[0])
    if len(items) == 1 and type(items[0]) is bytes:
        return np.bytes_(items[0])
    raise RemoteProtocolError("A numpy string is not made of one text.")


def _build_tensor(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    name = payload.decode("ascii", "replace")
    array = items[0] if len(items) == 1 else None
    if not isinstance(array, np.ndarray) or array.dtype.name != TENSOR_DTYPES.get(name):
        raise RemoteProtocolError("A tensor is not made of a fitting array.")
    if decoder.tensors is not None:
        return decoder.tensors(array, name)
    if name == "bfloat16":
        return (array.astype(np.uint32) << np.uint32(16)).view(np.float32)
    return array


def _build_enum(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    if len(items) != 3:
        raise RemoteProtocolError("An enumeration's member does not have three parts.")
    return RemoteEnum(*_inert_texts(items[:2]), items[2])


def _build_remote(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    return RemoteObject(*_inert_texts(items))


def _inert_texts(items: list[Any]) -> tuple[str, str]:
    if [type(item) for item in items] != [str, str]:
        raise RemoteProtocolError("A remote object is not made of two texts.")
    return one_line(items[0], MAX_NAME_CHARS), one_line(items[1], MAX_REPR_CHARS)


def _build_space(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    return decoder.make(SPACE, items)


def _build_spec(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    return decoder.make(SPEC, items)


def _build_generator(decoder: Decoder, items: list[Any], payload: bytes) -> object:
    return decoder.make(GENERATOR, items)


_READERS: dict[int, Callable[[Decoder, bytes], object]] = {
    ARRAY: _read_array,
    SCALAR: _read_scalar,
    INTEGER: _read_integer,
    COMPLEX: _read_complex,
    PICKLE: _read_pickle,
    PICKLE_FRAME: _read_pickle_frame,
}
_BUILDERS: dict[int, Callable[[Decoder, list[Any], bytes], object]] = {
    TUPLE: _build_tuple,
    SET: _build_set,
    FROZENSET: _build_frozenset,
    RANGE: _build_range,
    SLICE: _build_slice,
    OBJECTS: _build_objects,
    TEXT_SCALAR: _build_text_scalar,
    TENSOR: _build_tensor,
    ENUM: _build_enum,
    REMOTE: _build_remote,
    SPACE: _build_space,
    SPEC: _build_spec,
    GENERATOR: _build_generator,
}

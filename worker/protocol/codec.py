"""Values to frames and back. ``docs/values.md`` is the reference of the encoding.

The first frame holds a msgpack document and the bytes of small arrays; each large array is a
frame of its own. What msgpack has no type for is either an extension (arrays, numpy scalars, big
integers) or an array whose first element is an extension that says what the rest is (tuples,
sets, ranges). Nothing that ``decode`` is given can make it execute anything.
"""

from __future__ import annotations

import math
import struct
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np

from envhub_worker.protocol import structure
from envhub_worker.protocol.arrays import (
    Array,
    ArrayReader,
    ArrayWriter,
    Buffer,
    empty,
    pack_shape,
    read_scalar,
    unpack_shape,
    write_scalar,
)
from envhub_worker.protocol.errors import (
    LocalProtocolError,
    MessageTooLargeError,
    ProtocolError,
    RemoteProtocolError,
)
from envhub_worker.protocol.inert import (
    MAX_NAME_CHARS,
    MAX_REPR_CHARS,
    RemoteEnum,
    RemoteObject,
    describe,
    describe_enum,
    one_line,
)
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits

__all__ = ["Buffer", "RemoteEnum", "RemoteObject", "decode", "encode"]

Pickler = Callable[[object], bytes]
Unpickler = Callable[[bytes], object]
TensorMaker = Callable[[Array, str], object]

# Extensions that are a value by themselves.
ARRAY, SCALAR, INTEGER, COMPLEX, PICKLE = 1, 2, 3, 4, 5
# Extensions that head a msgpack array and say what its other elements make.
TUPLE, SET, FROZENSET, RANGE, SLICE, OBJECTS, TEXT_SCALAR, TENSOR, ENUM, REMOTE = range(16, 26)

_DOCUMENT_BYTES = struct.Struct("<I")
_COMPLEX = struct.Struct("<dd")
# Maps and sets up to this size are too small for colliding keys to cost anything.
_FEW_KEYS = 64
_MAX_SAME_HASH = 16

# torch dtype name to the numpy dtype that carries its bits.
_TENSOR_DTYPES = {
    "bool": "bool", "uint8": "uint8", "int8": "int8", "int16": "int16", "int32": "int32",
    "int64": "int64", "float16": "float16", "float32": "float32", "float64": "float64",
    "complex64": "complex64", "complex128": "complex128", "bfloat16": "uint16",
}  # fmt: skip


def encode(
    value: object,
    *,
    pickler: Pickler | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
) -> list[Buffer]:
    """Encodes a value as frames: the header, then one per large array.

    Args:
        value: Plain Python values, numpy arrays and scalars, torch tensors, nested in any way.
            Anything else crosses as ``RemoteObject``.
        pickler: Encodes objects that have no form of their own instead. Client to worker only.
        limits: What the receiver accepts.

    Returns:
        Frames to be sent in this order. Large contiguous arrays are not copied: nobody may
        write them until the frames are sent.

    Raises:
        LocalProtocolError: The value is cyclic, too deep, too large, or holds a dtype that
            cannot cross. The text names the path to the offender. Nothing was sent.
    """
    encoder = _Encoder(pickler, limits)
    try:
        frames = encoder.frames(value)
    except (ProtocolError, ValueError, OverflowError, RecursionError) as error:
        raise LocalProtocolError(_explain(value, error, limits, pickler)) from error
    _check_outgoing(frames, limits)
    return frames


def decode(
    frames: Sequence[Buffer],
    *,
    limits: WireLimits = DEFAULT_LIMITS,
    unpickler: Unpickler | None = None,
    tensors: TensorMaker | None = None,
    copy: bool = True,
) -> object:
    """Decodes frames into the value that was encoded.

    Trust: input from the worker. Sizes are checked before anything is allocated, every byte
    must be accounted for, and nothing is executed.

    Args:
        frames: As ``encode`` returned them.
        limits: What is accepted.
        unpickler: Decodes pickled objects; only a worker, which trusts its client, has one.
        tensors: Makes a tensor of an array and a dtype name (``"bfloat16"`` comes as uint16
            bits). Without it tensors come as arrays, bfloat16 as float32.
        copy: Arrays own their memory and can be written. Otherwise they are read-only and the
            large ones are views of ``frames``.

    Raises:
        MessageTooLargeError: Over one of ``limits``.
        RemoteProtocolError: Malformed in any other way.
    """
    document, tail, buffers = _split(frames, limits)
    structure.check(document, limits)
    reader = ArrayReader(tail, buffers, limits, copy)
    decoder = _Decoder(reader, limits, unpickler, tensors)
    value = decoder.value(document)
    reader.finish()
    return value


# --- encoding -----------------------------------------------------------------------------------


class _Encoder:
    """Turns one value into frames; msgpack calls ``default`` for what it cannot pack itself."""

    __slots__ = ("limits", "pickler", "writer")

    def __init__(self, pickler: Pickler | None, limits: WireLimits) -> None:
        self.pickler, self.limits = pickler, limits
        self.writer = ArrayWriter()

    def frames(self, value: object) -> list[Buffer]:
        document = self._pack(value)
        structure.check(document, self.limits)
        prefix = _DOCUMENT_BYTES.pack(len(document))
        return [b"".join((prefix, document, *self.writer.tail)), *self.writer.frames]

    def _pack(self, value: object) -> bytes:
        try:
            packed: bytes = msgpack.packb(value, default=self.default, strict_types=True)
        except UnicodeEncodeError:
            # Lone surrogates are not UTF-8. They arrive as the text "\\udc80", visibly.
            self.writer = ArrayWriter()
            packed = msgpack.packb(
                value,
                default=self.default,
                strict_types=True,
                unicode_errors="backslashreplace",
            )
        return packed

    def default(self, value: Any) -> object:
        """Returns what msgpack packs in place of ``value``."""
        write = _WRITERS.get(type(value))
        return write(self, value) if write is not None else _write_other(self, value)


def _write_array(encoder: _Encoder, array: Array) -> object:
    if array.dtype.kind != "O":
        return msgpack.ExtType(ARRAY, encoder.writer.add(array))
    return [msgpack.ExtType(OBJECTS, pack_shape(array.shape)), *array.ravel().tolist()]


def _write_scalar(encoder: _Encoder, scalar: np.generic) -> object:
    return msgpack.ExtType(SCALAR, write_scalar(scalar))


def _write_integer(encoder: _Encoder, value: int) -> object:
    size = value.bit_length() // 8 + 1
    if size > encoder.limits.int_bytes:
        raise LocalProtocolError(f"an integer of {size} bytes")
    return msgpack.ExtType(INTEGER, value.to_bytes(size, "little", signed=True))


def _write_complex(encoder: _Encoder, value: complex) -> object:
    return msgpack.ExtType(COMPLEX, _COMPLEX.pack(value.real, value.imag))


def _write_range(encoder: _Encoder, value: range) -> object:
    return [_HEADS[RANGE], value.start, value.stop, value.step]


def _write_slice(encoder: _Encoder, value: slice) -> object:
    return [_HEADS[SLICE], value.start, value.stop, value.step]


def _write_remote(encoder: _Encoder, value: RemoteObject) -> object:
    return [_HEADS[REMOTE], value.type_name, value.text]


def _write_remote_enum(encoder: _Encoder, value: RemoteEnum) -> object:
    return [_HEADS[ENUM], value.type_name, value.text, value.value]


def _write_enum(encoder: _Encoder, member: Enum) -> object:
    return [_HEADS[ENUM], *describe_enum(member), member.value]


def _write_tuple(encoder: _Encoder, value: tuple[object, ...]) -> object:
    return [_HEADS[TUPLE], *value]


def _write_set(encoder: _Encoder, value: set[object]) -> object:
    return [_HEADS[SET], *value]


def _write_frozenset(encoder: _Encoder, value: frozenset[object]) -> object:
    return [_HEADS[FROZENSET], *value]


def _write_tensor(encoder: _Encoder, tensor: Any) -> object:
    name = str(tensor.dtype).rpartition(".")[2]
    if name not in _TENSOR_DTYPES or str(tensor.layout) != "torch.strided":
        return _write_unknown(encoder, tensor)
    plain = tensor.detach().cpu().resolve_conj().resolve_neg()
    if name == "bfloat16":
        plain = plain.view(sys.modules["torch"].int16)
    array = plain.numpy().view(_TENSOR_DTYPES[name])
    return [msgpack.ExtType(TENSOR, name.encode()), array]


def _write_text_scalar(encoder: _Encoder, value: np.str_ | np.bytes_) -> object:
    plain = str(value) if isinstance(value, np.str_) else bytes(value)
    return [_HEADS[TEXT_SCALAR], plain]


def _write_other(encoder: _Encoder, value: Any) -> object:
    """Handles subclasses, arrays and tensors of other libraries, and the unknown."""
    if isinstance(value, Enum):
        return _write_enum(encoder, value)
    if isinstance(value, np.generic):
        return _write_scalar(encoder, value)
    if isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray):
        return _write_array(encoder, np.asarray(value))
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, getattr(torch, "Tensor", ())):
        return _write_tensor(encoder, value)
    if hasattr(type(value), "__array__") and hasattr(type(value), "__dlpack__"):
        return _write_foreign(encoder, value)
    for base, write in _BASES:
        if isinstance(value, base):
            return write(encoder, value)
    return _write_unknown(encoder, value)


def _write_foreign(encoder: _Encoder, value: Any) -> object:
    array = np.asarray(value)
    if array.dtype.name == "bfloat16":
        array = array.astype(np.float32)
    return _write_array(encoder, array)


def _write_unknown(encoder: _Encoder, value: object) -> object:
    if encoder.pickler is None:
        return _write_remote(encoder, describe(value))
    try:
        return msgpack.ExtType(PICKLE, encoder.pickler(value))
    except Exception as error:
        raise LocalProtocolError(f"{type(value).__name__} cannot be pickled: {error}") from error


_HEADS = {code: msgpack.ExtType(code, b"") for code in range(TUPLE, REMOTE + 1)}

_WRITERS: dict[type, Callable[[_Encoder, Any], object]] = {
    np.ndarray: _write_array,
    int: _write_integer,
    tuple: _write_tuple,
    set: _write_set,
    frozenset: _write_frozenset,
    complex: _write_complex,
    range: _write_range,
    slice: _write_slice,
    np.str_: _write_text_scalar,
    np.bytes_: _write_text_scalar,
    RemoteObject: _write_remote,
    RemoteEnum: _write_remote_enum,
    **{np.dtype(char).type: _write_scalar for char in "?bBhHiIlLqQefdFDmM"},
}

# Subclasses cross as the type that they extend.
_BASES: tuple[tuple[type, Callable[[_Encoder, Any], object]], ...] = (
    (str, lambda encoder, value: str.__str__(value)),
    (int, _write_integer),
    (float, lambda encoder, value: float.__float__(value)),
    (dict, lambda encoder, value: dict(value)),
    (list, lambda encoder, value: list(value)),
    (tuple, _write_tuple),
    (bytes, lambda encoder, value: bytes(value)),
    (complex, _write_complex),
    (set, _write_set),
    (frozenset, _write_frozenset),
)


def _check_outgoing(frames: Sequence[Buffer], limits: WireLimits) -> None:
    try:
        _check_sizes(frames, limits)
    except MessageTooLargeError as error:
        raise LocalProtocolError(f"The message is too large to be sent: {error}") from None


def _explain(value: object, error: Exception, limits: WireLimits, pickler: Pickler | None) -> str:
    """Says what cannot be sent, and where in the value it is."""
    found = _find_offender(value, limits, pickler, (), [])
    if found is None:
        return f"The value cannot be sent: {error}"
    path, reason = found
    return f"{_path_text(path)} cannot be sent: {reason}."


def _find_offender(
    value: object,
    limits: WireLimits,
    pickler: Pickler | None,
    path: tuple[object, ...],
    above: list[int],
) -> tuple[tuple[object, ...], str] | None:
    """Returns path and reason of the first value that is cyclic, too deep, or refused."""
    children = _children(value)
    if children is None:
        reason = _refusal(value, limits, pickler)
        return None if reason is None else (path, reason)
    if id(value) in above:
        return path, "it contains itself"
    if len(above) == limits.depth:
        return path, f"it is nested deeper than {limits.depth} containers"
    for step, child in children:
        found = _find_offender(child, limits, pickler, (*path, step), [*above, id(value)])
        if found is not None:
            return found
    return None


def _children(value: object) -> list[tuple[object, object]] | None:
    """Returns steps and elements of a container, None for a leaf."""
    if isinstance(value, dict):
        keys = [(key, key) for key in value if isinstance(key, tuple | frozenset | Enum)]
        return [*keys, *value.items()]
    if isinstance(value, list | tuple | set | frozenset):
        return list(enumerate(value))
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        return list(enumerate(value.ravel().tolist()))
    return None


def _refusal(value: object, limits: WireLimits, pickler: Pickler | None) -> str | None:
    try:
        _Encoder(pickler, limits).frames(value)
    except (ProtocolError, ValueError, OverflowError, RecursionError) as error:
        return str(error)
    return None


def _path_text(path: tuple[object, ...]) -> str:
    """Writes ``("info", "a", 3)`` as ``info["a"][3]``."""
    if not path:
        return "The value"
    first, *rest = path
    named = isinstance(first, str) and first.isidentifier()
    steps = [str(first)] if named else [f"value[{_step_text(first)}]"]
    return one_line("".join([*steps, *(f"[{_step_text(step)}]" for step in rest)]))


def _step_text(step: object) -> str:
    return '"' + step + '"' if isinstance(step, str) else describe(step).text


# --- decoding -----------------------------------------------------------------------------------


class _Head:
    """What stands first in a msgpack array and says what the array makes."""

    __slots__ = ("code", "payload")

    def __init__(self, code: int, payload: bytes) -> None:
        self.code, self.payload = code, payload


class _Decoder:
    """Rebuilds one value; msgpack calls its hooks in the order of the document."""

    __slots__ = ("_hashed_keys", "_heads", "limits", "reader", "tensors", "unpickler")

    def __init__(
        self,
        reader: ArrayReader,
        limits: WireLimits,
        unpickler: Unpickler | None,
        tensors: TensorMaker | None,
    ) -> None:
        self.reader, self.limits = reader, limits
        self.unpickler, self.tensors = unpickler, tensors
        self._heads = self._hashed_keys = 0

    def value(self, document: bytes) -> object:
        try:
            value = msgpack.unpackb(
                document,
                ext_hook=self._extension,
                list_hook=self._list,
                object_pairs_hook=self._map,
                strict_map_key=False,
            )
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
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
        result = dict(pairs)
        if len(result) != len(pairs):
            raise RemoteProtocolError("A map has a key twice.")
        return result

    def check_keys(self, keys: list[Any]) -> None:
        """Refuses keys chosen to collide, which would make a dict or set take quadratic time."""
        hashed = [key for key in keys if key.__class__ is not str]
        self._hashed_keys += len(hashed)
        if self._hashed_keys > self.limits.hashed_keys:
            raise MessageTooLargeError(
                f"More than {self.limits.hashed_keys} keys that are no text (hashed_keys)."
            )
        same = Counter(map(hash, hashed)).most_common(1)
        if same and same[0][1] > _MAX_SAME_HASH:
            raise RemoteProtocolError("Keys were chosen so that their hashes collide.")


def _read_array(decoder: _Decoder, payload: bytes) -> object:
    return decoder.reader.take(payload)


def _read_scalar(decoder: _Decoder, payload: bytes) -> object:
    return read_scalar(payload)


def _read_integer(decoder: _Decoder, payload: bytes) -> object:
    if len(payload) > decoder.limits.int_bytes:
        raise MessageTooLargeError(
            f"An integer of {len(payload)} bytes is over {decoder.limits.int_bytes} (int_bytes)."
        )
    return int.from_bytes(payload, "little", signed=True)


def _read_complex(decoder: _Decoder, payload: bytes) -> object:
    if len(payload) != _COMPLEX.size:
        raise RemoteProtocolError("A complex number does not have 16 bytes.")
    return complex(*_COMPLEX.unpack(payload))


def _read_pickle(decoder: _Decoder, payload: bytes) -> object:
    if decoder.unpickler is None:
        raise RemoteProtocolError("The message holds a pickled object, which is never loaded.")
    try:
        return decoder.unpickler(payload)
    except Exception as error:
        raise RemoteProtocolError(f"An object of the client cannot be loaded: {error}") from error


def _build_tuple(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    return tuple(items)


def _build_set(decoder: _Decoder, items: list[Any], payload: bytes) -> set[object]:
    if len(items) > _FEW_KEYS:
        decoder.check_keys(items)
    result = set(items)
    if len(result) != len(items):
        raise RemoteProtocolError("A set has an element twice.")
    return result


def _build_frozenset(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    return frozenset(_build_set(decoder, items, payload))


def _build_range(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    if [type(item) for item in items] != [int, int, int] or not items[2]:
        raise RemoteProtocolError("A range is not made of three integers.")
    return range(*items)


def _build_slice(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    if len(items) != 3:
        raise RemoteProtocolError("A slice does not have three parts.")
    return slice(*items)


def _build_objects(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    shape = unpack_shape(payload)
    if math.prod(shape) != len(items):
        raise RemoteProtocolError("An object array does not have as many elements as its shape.")
    if not items:
        return empty(np.dtype(object), shape)
    array = np.empty(len(items), dtype=object)
    # One by one: numpy would take apart elements that are sequences.
    for index, item in enumerate(items):
        array[index] = item
    return array.reshape(shape)


def _build_text_scalar(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    if len(items) == 1 and type(items[0]) is str:
        return np.str_(items[0])
    if len(items) == 1 and type(items[0]) is bytes:
        return np.bytes_(items[0])
    raise RemoteProtocolError("A numpy string is not made of one text.")


def _build_tensor(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    name = payload.decode("ascii", "replace")
    array = items[0] if len(items) == 1 else None
    if not isinstance(array, np.ndarray) or array.dtype.name != _TENSOR_DTYPES.get(name):
        raise RemoteProtocolError("A tensor is not made of a fitting array.")
    if decoder.tensors is not None:
        return decoder.tensors(array, name)
    if name == "bfloat16":
        return (array.astype(np.uint32) << np.uint32(16)).view(np.float32)
    return array


def _build_enum(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    if len(items) != 3:
        raise RemoteProtocolError("An enumeration's member does not have three parts.")
    return RemoteEnum(*_inert_texts(items[:2]), items[2])


def _build_remote(decoder: _Decoder, items: list[Any], payload: bytes) -> object:
    return RemoteObject(*_inert_texts(items))


def _inert_texts(items: list[Any]) -> tuple[str, str]:
    if [type(item) for item in items] != [str, str]:
        raise RemoteProtocolError("A remote object is not made of two texts.")
    return one_line(items[0], MAX_NAME_CHARS), one_line(items[1], MAX_REPR_CHARS)


_READERS: dict[int, Callable[[_Decoder, bytes], object]] = {
    ARRAY: _read_array,
    SCALAR: _read_scalar,
    INTEGER: _read_integer,
    COMPLEX: _read_complex,
    PICKLE: _read_pickle,
}
_BUILDERS: dict[int, Callable[[_Decoder, list[Any], bytes], object]] = {
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
}


def _split(frames: Sequence[Buffer], limits: WireLimits) -> tuple[bytes, Buffer, list[Buffer]]:
    """Checks the frames' sizes; returns document, tail of the header, and the other frames."""
    _check_sizes(frames, limits)
    header, *buffers = (_flat(frame) for frame in frames)
    if len(header) < _DOCUMENT_BYTES.size:
        raise RemoteProtocolError("The header is too short.")
    end = _DOCUMENT_BYTES.size + _DOCUMENT_BYTES.unpack_from(header)[0]
    if end > len(header):
        raise RemoteProtocolError("The header is shorter than it says.")
    return bytes(header[_DOCUMENT_BYTES.size : end]), header[end:], buffers


def _flat(frame: Buffer) -> Buffer:
    return frame if isinstance(frame, bytes) else memoryview(frame).cast("B")


def _check_sizes(frames: Sequence[Buffer], limits: WireLimits) -> None:
    if not frames:
        raise RemoteProtocolError("A message has no frame.")
    if len(frames) > limits.frames:
        raise MessageTooLargeError(f"{len(frames)} frames are over {limits.frames} (frames).")
    sizes = [frame.nbytes if isinstance(frame, memoryview) else len(frame) for frame in frames]
    caps = (
        ("header_bytes", sizes[0], limits.header_bytes),
        ("frame_bytes", max(sizes[1:], default=0), limits.frame_bytes),
        ("message_bytes", sum(sizes), limits.message_bytes),
    )
    for name, size, cap in caps:
        if size > cap:
            raise MessageTooLargeError(f"{size} bytes are over the limit of {cap} ({name}).")

"""Forms of numpy's and torch's values; encoder and decoder load this with the first one.

Arrays and scalars are descriptors in the header and raw bytes beside it. A descriptor says dtype,
shape, and whether the bytes are a frame of their own or come next in the tail of the header frame.
Descriptors name no index: the n-th one takes the n-th bytes, so nothing can be read twice, skipped,
or reached out of range.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from envhub_worker.protocol.codec import wire
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import (
    LocalProtocolError,
    MessageTooLargeError,
    RemoteProtocolError,
)
from envhub_worker.protocol.limits import WireLimits

Array = NDArray[Any]

# Up to this a frame of its own costs more than the copies (measured with ZeroMQ over ipc).
INLINE_BYTES = 16 * 1024
# The tail is copied a few times; beyond this, arrays become frames however small they are.
MAX_TAIL_BYTES = 128 * 1024
MAX_DIMENSIONS = 32
MAX_ELEMENTS = 2**40
MAX_STRING_ITEM_BYTES = 1024 * 1024

_FIXED = ("?", "<i1", "<i2", "<i4", "<i8", "<u1", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8")
_DTYPES: tuple[np.dtype[Any], ...] = tuple(np.dtype(text) for text in (*_FIXED, "<c8", "<c16"))
_TEXT, _BYTES, _DATETIME, _TIMEDELTA = range(len(_DTYPES), len(_DTYPES) + 4)
_SIZED = {"U": _TEXT, "S": _BYTES, "M": _DATETIME, "m": _TIMEDELTA}
_UNITS = ("generic", "Y", "M", "W", "D", "h", "m", "s", "ms", "us", "ns", "ps", "fs", "as")
MAX_UNIT_COUNT = 2**24 - 1

_OWN_FRAME = 0x80
_PARAMETER = struct.Struct("<I")
_SHAPES = tuple(struct.Struct(f"<{n}Q") for n in range(MAX_DIMENSIONS + 1))


_NUMBER_HEADS = {
    char: bytes((_DTYPES.index(np.dtype(char)),))
    for char in "?bBhHiIlLqQefdFD"
    if np.dtype(char) in _DTYPES
}
"""By the character of a dtype: "l" and "q" are the same integer on most platforms."""
NUMBERS = frozenset(_DTYPES)


class ArrayWriter:
    """Collects the bytes of one message's arrays, and describes each.

    Attributes:
        tail: Bytes of small arrays, in order.
        frames: Zero-copy views of large contiguous arrays (copies of others), in order. They
            alias the arrays, which must not be written until the frames are sent.
    """

    __slots__ = ("_tail_bytes", "frames", "tail")

    def __init__(self) -> None:
        self.tail: list[bytes] = []
        self.frames: list[memoryview] = []
        self._tail_bytes = 0

    def add(self, array: Array) -> Any:
        """Takes an array of any layout and byte order; returns the extension that describes it.
        Raises ``LocalProtocolError``: a dtype that is not on the list, such as void or long double.
        """
        in_tail, in_frame, plain = _descriptors(array.dtype, array.shape)
        if not plain:
            array = native(array)
        nbytes = array.nbytes
        if nbytes <= INLINE_BYTES and self._tail_bytes + nbytes <= MAX_TAIL_BYTES:
            self.tail.append(array.tobytes())
            self._tail_bytes += nbytes
            return in_tail
        self.frames.append(raw(array))
        return in_frame


class ArrayReader:
    """Hands out one message's arrays in the order of their descriptors, as copies.

    Trust: input from the worker. ``tail`` has the bytes of small arrays, ``frames`` those of large
    arrays, one frame each. A reader that ``borrows`` returns large arrays of numbers as views of
    their frames, which the worker may still write.
    """

    __slots__ = ("_borrows", "_frames", "_limits", "_next_byte", "_next_frame", "_tail")

    def __init__(
        self, tail: Buffer, frames: Sequence[Buffer], limits: WireLimits, *, borrows: bool = False
    ) -> None:
        self._borrows = borrows
        self._tail, self._next_byte = tail, 0
        self._frames, self._next_frame = frames, 0
        self._limits = limits

    def take(self, descriptor: bytes) -> Array:
        """Returns the array of the next descriptor, native in byte order and C-contiguous.
        Raises ``RemoteProtocolError``: its bytes are missing, or not what the descriptor says.
        """
        return self.read(*parse_descriptor(descriptor))

    def read(
        self, dtype: np.dtype[Any], shape: tuple[int, ...], nbytes: int, own_frame: bool
    ) -> Array:
        """Like ``take``, for a descriptor that ``parse_descriptor`` has already split."""
        if not nbytes:
            return np.empty(shape, dtype)
        array: Array
        if own_frame:
            array = np.ndarray(shape, dtype, self._frame(nbytes))
            if not self._borrows or dtype.kind in "bUM":  # these are copied, and then looked at
                array = array.copy()
        else:
            array = np.ndarray(shape, dtype, self._slice(nbytes))
        if dtype.kind in "bUM":
            check_content(array)
        return array

    def finish(self) -> None:
        """Raises ``RemoteProtocolError`` if any bytes were left over."""
        if self._next_byte != len(self._tail) or self._next_frame != len(self._frames):
            raise RemoteProtocolError("The message has array bytes that nothing describes.")

    def _slice(self, nbytes: int) -> bytearray:
        """Returns the next bytes of the tail; always a copy, for they are not aligned there."""
        end = self._next_byte + nbytes
        if end > len(self._tail):
            raise RemoteProtocolError("An array's bytes are missing in the header's tail.")
        raw = self._tail[self._next_byte : end]
        self._next_byte = end
        return bytearray(raw)

    def _frame(self, nbytes: int) -> Buffer:
        if nbytes > self._limits.frame_bytes:
            raise MessageTooLargeError(
                f"An array of {nbytes} bytes is over {self._limits.frame_bytes} (frame_bytes)."
            )
        if self._next_frame == len(self._frames):
            raise RemoteProtocolError("An array's frame is missing.")
        frame = self._frames[self._next_frame]
        self._next_frame += 1
        if len(frame) != nbytes:
            raise RemoteProtocolError(
                f"An array of {nbytes} bytes came with a frame of {len(frame)}."
            )
        return frame


def describe_dtype(dtype: np.dtype[Any]) -> bytes:
    """Returns the code of a dtype, followed by its parameter where it has one.
    Raises ``LocalProtocolError``: the dtype is not on the list.
    """
    number = _NUMBER_HEADS.get(dtype.char)
    if number is not None:
        return number
    code = _SIZED.get(dtype.kind)
    if code is None or dtype.names is not None:
        raise LocalProtocolError(f"dtype {dtype} has no form on the wire")
    return bytes((code,)) + _PARAMETER.pack(_parameter(dtype))


def read_dtype(code: int, descriptor: bytes, offset: int) -> tuple[np.dtype[Any], int]:
    """Returns the dtype of a code and the offset after its parameter, if it has one.
    Raises ``RemoteProtocolError``: unknown code, or a parameter that is missing or out of range.
    """
    if code < len(_DTYPES):
        return _DTYPES[code], offset
    if code > _TIMEDELTA or len(descriptor) < offset + _PARAMETER.size:
        raise RemoteProtocolError(f"Unknown dtype code {code}, or its parameter is missing.")
    (parameter,) = _PARAMETER.unpack_from(descriptor, offset)
    return _sized_dtype(code, parameter), offset + _PARAMETER.size


# Messages repeat: the same few descriptors come with every step.
@lru_cache(maxsize=1024)
def parse_descriptor(descriptor: bytes) -> tuple[np.dtype[Any], tuple[int, ...], int, bool]:
    """Splits a descriptor into dtype, shape, bytes of the array, and whether it has a frame.
    Raises ``RemoteProtocolError``: it is malformed or describes an absurd array.
    """
    if len(descriptor) < 2:
        raise RemoteProtocolError("An array descriptor is too short.")
    dtype, offset = read_dtype(descriptor[0], descriptor, 2)
    shape = unpack_shape(descriptor[offset:])
    if len(shape) != descriptor[1] & ~_OWN_FRAME:
        raise RemoteProtocolError("An array descriptor has a wrong number of dimensions.")
    nbytes = math.prod(shape) * dtype.itemsize
    own_frame = bool(descriptor[1] & _OWN_FRAME)
    if own_frame and not nbytes:
        raise RemoteProtocolError("An array without elements has a frame.")
    return dtype, shape, nbytes, own_frame


@lru_cache(maxsize=1024)
def _descriptors(dtype: np.dtype[Any], shape: tuple[int, ...]) -> tuple[Any, Any, bool]:
    """Descriptors for the tail and for a frame, and whether the bytes are sent unchanged."""
    plain = dtype.isnative and dtype.kind not in "US"
    # numpy's empty strings have no width; they travel as one character.
    head = describe_dtype(dtype if dtype.itemsize else np.dtype((dtype.kind, 1)))
    sizes = pack_shape(shape)
    in_tail = head[:1] + bytes((len(shape),)) + head[1:] + sizes
    in_frame = head[:1] + bytes((len(shape) | _OWN_FRAME,)) + head[1:] + sizes
    return msgpack.ExtType(wire.ARRAY, in_tail), msgpack.ExtType(wire.ARRAY, in_frame), plain


def pack_shape(shape: tuple[int, ...]) -> bytes:
    """Encodes a shape. Raises ``LocalProtocolError`` beyond 32 dimensions."""
    if len(shape) > MAX_DIMENSIONS:
        raise LocalProtocolError(f"an array of {len(shape)} dimensions")
    return _SHAPES[len(shape)].pack(*shape)


def unpack_shape(data: bytes) -> tuple[int, ...]:
    """Decodes ``pack_shape``. Raises ``RemoteProtocolError`` for anything else."""
    ndim, rest = divmod(len(data), 8)
    if rest or ndim > MAX_DIMENSIONS:
        raise RemoteProtocolError("A shape is malformed.")
    shape = _SHAPES[ndim].unpack(data)
    # numpy multiplies the sizes that are not 0, also of arrays without elements.
    if math.prod(size for size in shape if size) > MAX_ELEMENTS:
        raise RemoteProtocolError("An array has absurd dimensions.")
    return shape


def native(array: Array) -> Array:
    """Returns the array in native byte order, its text free of lone surrogates."""
    if not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("="))
    if array.dtype.kind in "US" and not array.dtype.itemsize:
        return array.astype(f"{array.dtype.kind}1")
    if array.dtype.kind != "U" or not array.size:
        return array
    points = np.ascontiguousarray(array.reshape(-1)).view(np.uint32)
    lone = (points >= 0xD800) & (points <= 0xDFFF)
    if not lone.any():
        return array
    replaced = np.where(lone, np.uint32(0xFFFD), points).astype(np.uint32)
    return replaced.view(array.dtype).reshape(array.shape)


def raw(array: Array) -> memoryview:
    """Returns the array's bytes in C order, without a copy where it is contiguous."""
    view: memoryview = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    return view


def _parameter(dtype: np.dtype[Any]) -> int:
    """Characters or bytes of a string dtype; unit and count of a time dtype."""
    if dtype.kind in "US":
        if dtype.itemsize > MAX_STRING_ITEM_BYTES:
            raise LocalProtocolError(f"dtype {dtype} is over {MAX_STRING_ITEM_BYTES} bytes")
        return dtype.itemsize // (4 if dtype.kind == "U" else 1)
    unit, count = np.datetime_data(dtype)
    if count > MAX_UNIT_COUNT:
        raise LocalProtocolError(f"dtype {dtype} has no form on the wire")
    return count << 8 | _UNITS.index(unit)


@lru_cache(maxsize=256)
def _sized_dtype(code: int, parameter: int) -> np.dtype[Any]:
    """Inverse of ``_parameter``. Raises ``RemoteProtocolError`` when out of range."""
    if code in (_TEXT, _BYTES):
        width = 4 if code == _TEXT else 1
        if not 1 <= parameter * width <= MAX_STRING_ITEM_BYTES:
            raise RemoteProtocolError("A string dtype is empty or too wide.")
        return np.dtype(f"<U{parameter}" if code == _TEXT else f"S{parameter}")
    count, unit = parameter >> 8, parameter & 0xFF
    if unit >= len(_UNITS) or not count or (unit == 0 and count != 1):
        raise RemoteProtocolError("A time dtype has an unknown unit.")
    kind = "M8" if code == _DATETIME else "m8"
    return np.dtype(f"<{kind}[{count}{_UNITS[unit]}]" if unit else f"<{kind}")


def check_content(array: Array) -> None:
    """Refuses bytes that are not values of their dtype.

    numpy counts a mask's True values by adding its bytes and writes that many elements, so
    that a boolean of 2 reaches outside of an array; a character beyond Unicode makes str fail,
    and so does a time without a unit.
    """
    if array.dtype.kind == "U":
        points = array.reshape(-1).view(np.uint32)
        if points.max() > 0x10FFFF or ((points >= 0xD800) & (points <= 0xDFFF)).any():
            raise RemoteProtocolError("A string array holds something that is no character.")
    elif array.dtype.kind == "M":
        if np.datetime_data(array.dtype)[0] == "generic" and not np.isnat(array).all():
            raise RemoteProtocolError("A time has no unit.")
    elif array.size <= 1024:
        if array.tobytes().strip(b"\0\1"):
            raise RemoteProtocolError("A boolean is neither 0 nor 1.")
    elif array.view(np.uint8).max() > 1:
        raise RemoteProtocolError("A boolean is neither 0 nor 1.")


# --- forms --------------------------------------------------------------------------------------

Encoder = Any
"""An ``encoder.Encoder``, which imports this module."""


def add(encoder: Encoder, array: Array) -> Any:
    """Takes the bytes of an array into a message; returns the extension that describes it."""
    if encoder.writer is None:
        encoder.writer = ArrayWriter()
    return encoder.writer.add(array)


Tensors = Callable[[Array, str], object] | None

_WIDEST: dict[str, Any] = {"g": np.float64, "G": np.complex128}
"""What long doubles arrive as; structured and raw elements do as tuples and bytes. None of this on
the way to a worker: what the caller hands over arrives exactly as it is, or is refused."""


def _write_array(encoder: Encoder, array: Array) -> object:
    if array.dtype.char in _WIDEST and encoder.pickler is None:
        array = array.astype(_WIDEST[array.dtype.char])
    if array.dtype.kind not in ("O" if encoder.pickler else "OV"):
        return add(encoder, array)
    return [msgpack.ExtType(wire.OBJECTS, pack_shape(array.shape)), *array.ravel().tolist()]


def _write_scalar(encoder: Encoder, scalar: np.generic) -> object:
    """Encodes a numpy scalar as dtype code, parameter and value; a structured value is a tuple."""
    number = _NUMBER_HEADS.get(scalar.dtype.char)
    if number is not None:
        return msgpack.ExtType(wire.SCALAR, number + scalar.tobytes())
    if isinstance(scalar, np.void) and encoder.pickler is None:
        plain = scalar.item()
        return plain if type(plain) is bytes else encoder.default(plain)
    if scalar.dtype.char in _WIDEST and encoder.pickler is None:
        scalar = _WIDEST[scalar.dtype.char](scalar)
    array = native(np.asarray(scalar))
    return msgpack.ExtType(wire.SCALAR, describe_dtype(array.dtype) + array.tobytes())


def _write_text_scalar(encoder: Encoder, value: np.str_ | np.bytes_) -> object:
    plain = str.__str__(value) if isinstance(value, np.str_) else bytes(value)
    return [msgpack.ExtType(wire.TEXT_SCALAR, b""), plain]


_TENSOR_HEADS = {name: msgpack.ExtType(wire.TENSOR, name.encode()) for name in wire.TENSOR_DTYPES}


def tensor_bits(tensor: Any) -> tuple[str, Array | None]:
    """Torch's name of a tensor's dtype, and an array of its bits; None if the wire has no form."""
    name, strided = _tensor_form(tensor.dtype, tensor.layout)
    if not strided or name not in wire.TENSOR_DTYPES:
        return name, None
    try:
        return name, tensor.numpy()
    except (RuntimeError, TypeError):  # it has a gradient, lies elsewhere, or is a view of a kind
        plain = tensor.detach().cpu().resolve_conj().resolve_neg()
        if name == "bfloat16":
            plain = plain.view(sys.modules["torch"].int16)
        return name, plain.numpy().view(wire.TENSOR_DTYPES[name])


@lru_cache(maxsize=64)
def _tensor_form(dtype: Any, layout: Any) -> tuple[str, bool]:
    """The name of a tensor's dtype without ``torch.``, and whether the tensor is dense."""
    return str(dtype).rpartition(".")[2], str(layout) == "torch.strided"


def write_numpy(encoder: Encoder, value: Any) -> object:
    """The wire's form of an array subclass or another library's array, else NotImplemented."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, getattr(torch, "Tensor", ())):
        name, bits = tensor_bits(value)
        return encoder.unknown(value) if bits is None else [_TENSOR_HEADS[name], add(encoder, bits)]
    if isinstance(value, (np.str_, np.bytes_)):
        return _write_text_scalar(encoder, value)
    if isinstance(value, np.generic):
        return _write_scalar(encoder, value)
    if isinstance(value, np.ndarray):
        masked = sys.modules.get("numpy.ma")  # np.ma would import it, which takes 10 ms and 1 MB
        if isinstance(value, getattr(masked, "MaskedArray", ())):  # a thread may be importing it
            return encoder.unknown(value)
        return _write_array(encoder, np.asarray(value))
    if hasattr(type(value), "__array__") and hasattr(type(value), "__dlpack__"):
        array = np.asarray(value)
        widened = array.astype(np.float32) if array.dtype.name == "bfloat16" else array
        return _write_array(encoder, widened)
    return NotImplemented


WRITERS: dict[type, Callable[[Encoder, Any], object]] = {
    np.ndarray: _write_array,
    np.str_: _write_text_scalar,
    np.bytes_: _write_text_scalar,
    **{np.dtype(char).type: _write_scalar for char in "?bBhHiIlLqQefdFDmM"},
}
"""By the exact type."""


def read_numpy_scalar(data: bytes) -> np.generic:
    """Decodes a numpy scalar. Trust: input from the worker. Raises ``RemoteProtocolError``."""
    if not data:
        raise RemoteProtocolError("A numpy scalar is empty.")
    dtype, offset = read_dtype(data[0], data, 1)
    if len(data) != offset + dtype.itemsize:
        raise RemoteProtocolError("A numpy scalar has a wrong number of bytes.")
    flat = np.frombuffer(data, dtype, 1, offset)
    if dtype.kind in "bUM":
        check_content(flat)
    scalar: np.generic = flat[0]
    return scalar


def _build_objects(payload: bytes, items: list[Any], tensors: Tensors) -> object:
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


def _build_text_scalar(payload: bytes, items: list[Any], tensors: Tensors) -> object:
    if len(items) == 1 and type(items[0]) is str:
        return np.str_(items[0])
    if len(items) == 1 and type(items[0]) is bytes:
        return np.bytes_(items[0])
    raise RemoteProtocolError("A numpy string is not made of one text.")


def _build_tensor(payload: bytes, items: list[Any], tensors: Tensors) -> object:
    name = payload.decode("ascii", "replace")
    array = items[0] if len(items) == 1 else None
    if not isinstance(array, np.ndarray) or array.dtype.name != wire.TENSOR_DTYPES.get(name):
        raise RemoteProtocolError("A tensor is not made of a fitting array.")
    return tensor(array, name, tensors)


def tensor(array: Array, name: str, tensors: Tensors) -> object:
    """Makes a tensor from the array of its bits; returns an array if none can be made here."""
    if tensors is not None:
        return tensors(array, name)
    return widened_numpy(array) if name == "bfloat16" else array


def widened_numpy(bits: Array) -> Array:
    """Converts bfloat16 bits (uint16) to float32."""
    wide: Array = (bits.astype(np.uint32) << np.uint32(16)).view(np.float32)
    return wide


BUILDERS: dict[int, Callable[[bytes, list[Any], Tensors], object]] = {
    wire.OBJECTS: _build_objects,
    wire.TEXT_SCALAR: _build_text_scalar,
    wire.TENSOR: _build_tensor,
}

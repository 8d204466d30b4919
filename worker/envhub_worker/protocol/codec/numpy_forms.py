"""Forms of numpy's and torch's values; encoder and decoder load this with the first one."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np

from envhub_worker.protocol.codec import wire
from envhub_worker.protocol.codec.arrays import (
    Array,
    check_content,
    describe_dtype,
    native,
    pack_shape,
    read_dtype,
    unpack_shape,
)
from envhub_worker.protocol.errors import RemoteProtocolError

Encoder = Any
"""An ``encoder.Encoder``, which imports this module."""
Tensors = Callable[[Array, str], object] | None


_WIDEST: dict[str, Any] = {"g": np.float64, "G": np.complex128}
"""What long doubles arrive as; structured and raw elements do as tuples and bytes. None of this on
the way to a worker: what the caller hands over arrives exactly as it is, or is refused."""


def _write_array(encoder: Encoder, array: Array) -> object:
    if array.dtype.char in _WIDEST and encoder.pickler is None:
        array = array.astype(_WIDEST[array.dtype.char])
    if array.dtype.kind not in ("O" if encoder.pickler else "OV"):
        return msgpack.ExtType(wire.ARRAY, encoder.array(array))
    return [msgpack.ExtType(wire.OBJECTS, pack_shape(array.shape)), *array.ravel().tolist()]


def _write_scalar(encoder: Encoder, scalar: np.generic) -> object:
    """Dtype code, parameter, value; a structured one is a tuple."""
    if isinstance(scalar, np.void) and encoder.pickler is None:
        plain = scalar.item()
        return plain if type(plain) is bytes else encoder.default(plain)
    if scalar.dtype.char in _WIDEST and encoder.pickler is None:
        scalar = _WIDEST[scalar.dtype.char](scalar)
    array = native(np.asarray(scalar))
    return msgpack.ExtType(wire.SCALAR, describe_dtype(array.dtype) + array.tobytes())


def _write_text_scalar(encoder: Encoder, value: np.str_ | np.bytes_) -> object:
    plain = str(value) if isinstance(value, np.str_) else bytes(value)
    return [msgpack.ExtType(wire.TEXT_SCALAR, b""), plain]


def _write_tensor(encoder: Encoder, tensor: Any) -> object:
    name = str(tensor.dtype).rpartition(".")[2]
    if name not in wire.TENSOR_DTYPES or str(tensor.layout) != "torch.strided":
        return encoder.unknown(tensor)
    plain = tensor.detach().cpu().resolve_conj().resolve_neg()
    if name == "bfloat16":
        plain = plain.view(sys.modules["torch"].int16)
    array = plain.numpy().view(wire.TENSOR_DTYPES[name])
    return [msgpack.ExtType(wire.TENSOR, name.encode()), array]


def write_numpy(encoder: Encoder, value: Any) -> object:
    """The form of a subclass, or of another library's array; NotImplemented of all else."""
    if isinstance(value, np.generic):
        return _write_scalar(encoder, value)
    if isinstance(value, np.ma.MaskedArray):
        return encoder.unknown(value)
    if isinstance(value, np.ndarray):
        return _write_array(encoder, np.asarray(value))
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, getattr(torch, "Tensor", ())):
        return _write_tensor(encoder, value)
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
    """A numpy scalar. Trust: input from the worker.

    Raises:
        RemoteProtocolError: It is none.
    """
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
    if tensors is not None:
        return tensors(array, name)
    return widened_numpy(array) if name == "bfloat16" else array


def widened_numpy(bits: Array) -> Array:
    """The float32 of bfloat16 bits."""
    wide: Array = (bits.astype(np.uint32) << np.uint32(16)).view(np.float32)
    return wide


BUILDERS: dict[int, Callable[[bytes, list[Any], Tensors], object]] = {
    wire.OBJECTS: _build_objects,
    wire.TEXT_SCALAR: _build_text_scalar,
    wire.TENSOR: _build_tensor,
}

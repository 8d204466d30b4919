"""Values to one msgpack document and the bytes of its arrays."""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import Enum
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np

from envhub_worker.protocol.codec import structure
from envhub_worker.protocol.codec.arrays import Array, ArrayWriter, pack_shape, write_scalar
from envhub_worker.protocol.codec.exact import Pickled, Pickler
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject, describe, describe_enum
from envhub_worker.protocol.codec.kinds import (
    ARRAY,
    COMPLEX,
    COMPLEX_BYTES,
    DOCUMENT_BYTES,
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
    TENSOR,
    TENSOR_DTYPES,
    TEXT_SCALAR,
    TUPLE,
    Buffer,
)
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.limits import WireLimits

Describer = Callable[[object], "tuple[int, object] | None"]
"""The code and the plain value of what the peer can make again; None of all else."""


class Encoder:
    """Turns one value into frames; msgpack calls ``default`` for what it cannot pack itself."""

    __slots__ = ("describer", "limits", "pickler", "writer")

    def __init__(
        self, pickler: Pickler | None, limits: WireLimits, describer: Describer | None = None
    ) -> None:
        self.pickler, self.limits, self.describer = pickler, limits, describer
        self.writer = ArrayWriter()

    def frames(self, value: object) -> list[Buffer]:
        """Returns the header frame and the arrays' frames."""
        document = self._pack(value)
        structure.check(document, self.limits)
        prefix = DOCUMENT_BYTES.pack(len(document))
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
        return _WRITERS.get(type(value), _write_other)(self, value)


def _write_array(encoder: Encoder, array: Array) -> object:
    if array.dtype.kind != "O":
        return msgpack.ExtType(ARRAY, encoder.writer.add(array))
    return [msgpack.ExtType(OBJECTS, pack_shape(array.shape)), *array.ravel().tolist()]


def _write_scalar(encoder: Encoder, scalar: np.generic) -> object:
    return msgpack.ExtType(SCALAR, write_scalar(scalar))


def _write_integer(encoder: Encoder, value: int) -> object:
    size = value.bit_length() // 8 + 1
    if size > encoder.limits.int_bytes:
        raise LocalProtocolError(f"an integer of {size} bytes")
    return msgpack.ExtType(INTEGER, value.to_bytes(size, "little", signed=True))


def _write_complex(encoder: Encoder, value: complex) -> object:
    return msgpack.ExtType(COMPLEX, COMPLEX_BYTES.pack(value.real, value.imag))


def _write_range(encoder: Encoder, value: range) -> object:
    return [_HEADS[RANGE], value.start, value.stop, value.step]


def _write_slice(encoder: Encoder, value: slice) -> object:
    return [_HEADS[SLICE], value.start, value.stop, value.step]


def _write_remote(encoder: Encoder, value: RemoteObject) -> object:
    return [_HEADS[REMOTE], value.type_name, value.text]


def _write_remote_enum(encoder: Encoder, value: RemoteEnum) -> object:
    return [_HEADS[ENUM], value.type_name, value.text, value.value]


def _write_enum(encoder: Encoder, member: Enum) -> object:
    return [_HEADS[ENUM], *describe_enum(member), member.value]


def _write_tuple(encoder: Encoder, value: tuple[object, ...]) -> object:
    return [_HEADS[TUPLE], *value]


def _write_set(encoder: Encoder, value: set[object]) -> object:
    return [_HEADS[SET], *value]


def _write_frozenset(encoder: Encoder, value: frozenset[object]) -> object:
    return [_HEADS[FROZENSET], *value]


def _write_tensor(encoder: Encoder, tensor: Any) -> object:
    name = str(tensor.dtype).rpartition(".")[2]
    if name not in TENSOR_DTYPES or str(tensor.layout) != "torch.strided":
        return _write_unknown(encoder, tensor)
    plain = tensor.detach().cpu().resolve_conj().resolve_neg()
    if name == "bfloat16":
        plain = plain.view(sys.modules["torch"].int16)
    array = plain.numpy().view(TENSOR_DTYPES[name])
    return [msgpack.ExtType(TENSOR, name.encode()), array]


def _write_text_scalar(encoder: Encoder, value: np.str_ | np.bytes_) -> object:
    plain = str(value) if isinstance(value, np.str_) else bytes(value)
    return [_HEADS[TEXT_SCALAR], plain]


def _write_other(encoder: Encoder, value: Any) -> object:
    """Handles subclasses, arrays and tensors of other libraries, and the unknown."""
    if isinstance(value, Enum):
        return _write_enum(encoder, value)
    if isinstance(value, np.generic):
        return _write_scalar(encoder, value)
    if isinstance(value, np.ma.MaskedArray):
        return _write_unknown(encoder, value)
    if isinstance(value, np.ndarray):
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


def _write_foreign(encoder: Encoder, value: Any) -> object:
    array = np.asarray(value)
    if array.dtype.name == "bfloat16":
        array = array.astype(np.float32)
    return _write_array(encoder, array)


def _write_unknown(encoder: Encoder, value: object) -> object:
    if encoder.pickler is None:
        found = None if encoder.describer is None else encoder.describer(value)
        if found is not None:
            return [_HEADS[found[0]], found[1]]
        return _write_remote(encoder, describe(value))
    try:
        data = encoder.pickler(value)
    except Exception as error:
        raise LocalProtocolError(f"{type(value).__name__} cannot be pickled: {error}") from error
    return _write_pickled(encoder, Pickled(data))


def _write_pickled(encoder: Encoder, pickled: Pickled) -> object:
    data = pickled.data
    if type(data) is bytes:
        return msgpack.ExtType(PICKLE, data)
    return msgpack.ExtType(PICKLE_FRAME, encoder.writer.add(np.frombuffer(data, np.uint8)))


_HEADS = {code: msgpack.ExtType(code, b"") for code in range(TUPLE, GENERATOR + 1)}

_WRITERS: dict[type, Callable[[Encoder, Any], object]] = {
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
    Pickled: _write_pickled,
    RemoteObject: _write_remote,
    RemoteEnum: _write_remote_enum,
    **{np.dtype(char).type: _write_scalar for char in "?bBhHiIlLqQefdFDmM"},
}

# Subclasses cross as the type that they extend.
_BASES: tuple[tuple[type, Callable[[Encoder, Any], object]], ...] = (
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

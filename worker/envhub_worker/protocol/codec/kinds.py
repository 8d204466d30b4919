"""The extension codes of the value encoding. They never change; ``docs/values.md`` lists them."""

from __future__ import annotations

import struct

Buffer = bytes | memoryview

# Extensions that are a value by themselves.
ARRAY, SCALAR, INTEGER, COMPLEX, PICKLE, PICKLE_FRAME = 1, 2, 3, 4, 5, 6
# Extensions that head a msgpack array and say what its other elements make.
TUPLE, SET, FROZENSET, RANGE, SLICE, OBJECTS, TEXT_SCALAR, TENSOR, ENUM, REMOTE = range(16, 26)
# The same, of what only a client makes: one plain value that describes it.
SPACE, SPEC, GENERATOR = range(26, 29)

# The header frame: length of the msgpack document, the document, bytes of small arrays.
DOCUMENT_BYTES = struct.Struct("<I")
COMPLEX_BYTES = struct.Struct("<dd")

# torch dtype name to the numpy dtype that carries its bits.
TENSOR_DTYPES = {
    "bool": "bool", "uint8": "uint8", "int8": "int8", "int16": "int16", "int32": "int32",
    "int64": "int64", "float16": "float16", "float32": "float32", "float64": "float64",
    "complex64": "complex64", "complex128": "complex128", "bfloat16": "uint16",
}  # fmt: skip

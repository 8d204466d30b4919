"""Arrays beside the header: every layout arrives as it was, and no lie about one is believed."""

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from envhub_worker.protocol import errors
from envhub_worker.protocol.codec import arrays
from envhub_worker.protocol.codec.arrays import ArrayReader, ArrayWriter, read_numpy_scalar
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from tests.support.compare import assert_same
from tests.support.decode import decode

LARGE = arrays.INLINE_BYTES + 8
NUMBERS = ["?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16"]
DTYPES = [*NUMBERS, "U7", "S5", "M8[ns]", "m8[25s]", "M8", "m8"]
TEXT = st.characters(exclude_categories=["Cs"], exclude_characters="\0")


def through(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    writer = ArrayWriter()
    descriptor = writer.add(array).data
    reader = ArrayReader(b"".join(writer.tail), writer.frames, DEFAULT_LIMITS)
    read = reader.take(descriptor)
    reader.finish()
    return read


def read(
    descriptor: bytes,
    tail: bytes = b"",
    frames: tuple[bytes, ...] = (),
    limits: WireLimits = DEFAULT_LIMITS,
) -> np.ndarray[Any, Any]:
    """Reads one array out of hand-made bytes, to the end."""
    reader = ArrayReader(tail, frames, limits)
    array = reader.take(descriptor)
    reader.finish()
    return array


def descriptor(code: int, *shape: int, frame: bool = False, parameter: int | None = None) -> bytes:
    head = bytes((code, len(shape) | (0x80 if frame else 0)))
    middle = b"" if parameter is None else struct.pack("<I", parameter)
    return head + middle + struct.pack(f"<{len(shape)}Q", *shape)


@given(
    array=st.sampled_from(DTYPES).flatmap(
        lambda name: hnp.arrays(
            np.dtype(name),
            hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
            elements=st.text(TEXT, max_size=7) if name[0] == "U" else None,
        )
    ),
    order=st.sampled_from("CF"),
)
def test_every_dtype_and_shape_arrives_as_it_was(array: np.ndarray[Any, Any], order: Any) -> None:
    assert_same(array, through(np.array(array, order=order)))


@pytest.mark.parametrize(
    "view",
    [
        np.arange(24).reshape(4, 6)[::-1, ::2],
        np.arange(24).reshape(2, 3, 4).transpose(2, 0, 1),
        np.asfortranarray(np.arange(6000.0).reshape(60, 100)),
        np.arange(6000.0)[::-1],
        np.broadcast_to(np.float32(3), (50, 50)),
        np.arange(5, dtype=">i4"),
        np.arange(5000, dtype=">f8"),
        np.array(["2020-01-01", "NaT"], dtype=">M8[D]"),
        np.array(["é", "\U0001f600x"], dtype=">U2"),
        np.array(2.5, dtype=">f4"),
    ],
)
def test_layout_and_byte_order_do_not_matter(view: np.ndarray[Any, Any]) -> None:
    assert_same(view.astype(view.dtype.newbyteorder("=")), through(view))


@pytest.mark.parametrize(
    ("array", "arrived"),
    [
        (np.zeros(3, dtype=[("x", "U0")])["x"], ["", "", ""]),  # of width one: 0 has no bytes
        (np.array(["a\udc80b", "c"]), ["a\ufffdb", "c"]),  # what no UTF-8 can carry
    ],
)
def test_strings_that_cannot_arrive_as_they_are(array: Any, arrived: list[str]) -> None:
    assert through(array).tolist() == arrived


def test_large_contiguous_array_is_not_copied_when_written() -> None:
    array = np.zeros(LARGE, np.uint8)
    writer = ArrayWriter()
    writer.add(array)
    assert np.shares_memory(np.frombuffer(writer.frames[0], np.uint8), array)


def test_tail_is_bounded() -> None:
    writer = ArrayWriter()
    for _ in range(2 * arrays.MAX_TAIL_BYTES // arrays.INLINE_BYTES):
        writer.add(np.zeros(arrays.INLINE_BYTES, np.uint8))
    assert sum(map(len, writer.tail)) == arrays.MAX_TAIL_BYTES
    assert len(writer.frames) == arrays.MAX_TAIL_BYTES // arrays.INLINE_BYTES


def test_misaligned_frames_give_aligned_arrays() -> None:
    """A transport may cut frames out of one buffer anywhere; native code needs alignment."""
    frame = memoryview(bytes(1 + 8 * LARGE))[1:]
    reader = ArrayReader(b"", [frame], DEFAULT_LIMITS)
    assert reader.take(descriptor(11, LARGE, frame=True)).flags.aligned


@pytest.mark.parametrize(
    "dtype", [object, "V4", [("a", "f4")], np.longdouble, np.clongdouble, "U300000", "S2000000"]
)
def test_dtypes_off_the_list_are_refused_before_sending(dtype: Any) -> None:
    with pytest.raises(errors.LocalProtocolError):
        ArrayWriter().add(np.zeros(1, dtype))


def test_more_than_32_dimensions_are_refused_before_sending() -> None:
    """numpy 2 allows 64 dimensions, numpy 1 only 32; the wire allows what both can hold."""
    with pytest.raises(errors.LocalProtocolError):
        arrays.pack_shape((1,) * 33)


F4, BOOL, TEXT_CODE, BYTES_CODE, TIME_CODE, TIMEDELTA_CODE = 10, 0, 14, 15, 16, 17


def test_hand_made_descriptor_is_understood() -> None:
    tail = np.arange(6, dtype="<f4").tobytes()
    assert_same(np.arange(6, dtype="f4").reshape(2, 3), read(descriptor(F4, 2, 3), tail))


ONE = descriptor(F4, 1)
FRAMED = descriptor(F4, 1, frame=True)


@pytest.mark.parametrize(
    ("spoiled", "tail", "frames"),
    [
        *((lie, b"", ()) for lie in (b"", b"\x0a", bytes((F4, 33)) + bytes(8 * 33))),
        *((lie, bytes(4), ()) for lie in (ONE[:-1], ONE + b"\0", FRAMED)),
        *((ONE, bytes(size), ()) for size in (3, 5)),
        *((FRAMED, b"", frames) for frames in ((bytes(3),), (bytes(5),), (bytes(4), bytes(4)))),
        *((descriptor(F4, 0, frame=True), b"", (b"",)), (ONE, b"", (bytes(4),))),
        *((descriptor(F4, size), bytes(4), ()) for size in (2**62, 2**64 - 1)),
        (descriptor(F4, 2**62 + 1, 4), bytes(16), ()),
        *((descriptor(F4, *s), b"", ()) for s in ((2**63, 2**63, 2), (0, 2**62), (2,) * 40)),
        (bytes((F4, 2)) + bytes(8), b"", ()),
        *((descriptor(code, 1), bytes(4), ()) for code in (18, 255)),
        (descriptor(TEXT_CODE), b"", ()),
        *((descriptor(TEXT_CODE, 1, parameter=p), b"", ()) for p in (0, 2_000_000_000)),
        (descriptor(BYTES_CODE, 1, parameter=2**32 - 1), b"", ()),
        *(
            (descriptor(TEXT_CODE, 1, parameter=1), struct.pack("<I", point), ())
            for point in (0x110000, 0xD800)
        ),
        *(
            (descriptor(TIME_CODE, 1, parameter=p), bytes(8), ())
            for p in (0x0000_0001, 0x0000_01FF)
        ),
        (descriptor(TIMEDELTA_CODE, 1, parameter=0x0000_0200), bytes(8), ()),
        (descriptor(BOOL, 2), b"\1\2", ()),
        (descriptor(BOOL, 2000), bytes(1999) + b"\xff", ()),
    ],
)
def test_a_lying_array_is_refused(spoiled: bytes, tail: bytes, frames: tuple[bytes, ...]) -> None:
    with pytest.raises(errors.RemoteProtocolError):
        read(spoiled, tail, frames)


def test_array_larger_than_a_frame_may_be_is_refused() -> None:
    with pytest.raises(errors.MessageTooLargeError, match="frame_bytes"):
        read(descriptor(F4, 2**30, frame=True), b"", (b"",))


@pytest.mark.parametrize("name", DTYPES)
def test_scalar_comes_back_as_the_same_numpy_type(name: str) -> None:
    # a time without a unit is none, but for the one that stands for no time
    scalar = np.array(["NaT"], "M8")[0] if name == "M8" else np.ones(1, np.dtype(name))[0]
    assert_same(scalar, decode(encode(scalar)))


@pytest.mark.parametrize(
    "data", [b"", b"\x0a", b"\x0a" + bytes(3), b"\x0a" + bytes(5), b"\x00\x02", b"\xff\x00\x00"]
)
def test_malformed_scalar_is_refused(data: bytes) -> None:
    with pytest.raises(errors.RemoteProtocolError):
        read_numpy_scalar(data)

"""Malformed and oversized messages are refused, and the error says that the peer is to blame."""

import pickle
import struct
from functools import partial
from typing import Any

import msgpack
import numpy as np
import pytest

from envhub_worker.protocol import errors
from envhub_worker.protocol.codec.decoder import Decoder
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.codec.wire import GENERATOR, Buffer, split_frames
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from tests.support.compare import assert_same
from tests.support.decode import decode
from tests.support.wire import deep, ext, message, not_refused, packed

SMALL = WireLimits(
    header_bytes=4096,
    frame_bytes=100_000,
    message_bytes=150_000,
    frames=4,
    depth=5,
    items=100,
    text_bytes=50,
    int_bytes=16,
    hashed_keys=80,
)


def test_times_without_a_unit_are_refused() -> None:
    """Their ``repr`` raises, wherever a program prints one; the one that is no time has one."""
    times = np.array([4, 5]).view("M8")
    for value in (times, times[0]):
        with pytest.raises(errors.RemoteProtocolError, match="no unit"):
            decode(encode(value))
    for value in (np.array(["NaT"], "M8"), np.array([4]).view("m8")):
        assert_same(value, decode(encode(value)))


MALFORMED: list[list[Buffer]] = [
    *([], [b""], [b"\0\0\0"]),
    *([struct.pack("<I", length) + b"\xc0"] for length in (5, 2**32 - 1)),
    *(message(b"\xc0", b"tail"), message(b"\xc0", b"", b"frame")),
    *map(message, (b"", b"\xc0\xc0", b"\xc1", b"\x91", b"\xa5abc", b"\xa1\xff")),
    *map(message, (b"\xd9\x02\xed\xa0", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff")),
    *map(message, (b"\xc6\xff\xff\xff\xff", b"\xc9\xff\xff\xff\xff\x01")),
    # keys that are there twice, or cannot be hashed
    *map(message, (b"\x82\xa1a\x01\xa1a\x02", b"\x82\x01\x01\xc3\x02", b"\x81\x90\x01")),
    *map(message, (b"\x82\x01\x01\xcb" + struct.pack(">d", 1.0) + b"\x02", b"\x81\x80\x01")),
    # timestamps and other extensions that there are not
    *map(message, (b"\xd6\xff\0\0\0\0", b"\xd7\xff" + bytes(8), b"\xc7\x0c\xff" + bytes(12))),
    *map(message, (b"\xc7\x04\xff" + bytes(4), b"\xc8\x00\x04\xff" + bytes(4))),
    message(b"\xc9\x00\x00\x00\x04\xff" + bytes(4)),
    *map(message, (b"\xd4\x00\x00", b"\xd4\x7f\x00", b"\xd4\x80\x00")),
    message(b"\x92" + msgpack.packb([[]] * 40) + b"\xd6\xff" + bytes(4)),
    *map(packed, (ext(6, b"x"), ext(15), ext(26))),
    # heads that stand elsewhere
    *map(packed, (ext(16), [1, ext(16)], [ext(16), ext(16)], [ext(17), ext(17)])),
    *map(packed, ({"a": ext(16)}, [[ext(18)], ext(18)])),
    # tuples, sets, ranges and slices
    *map(packed, ([ext(16, b"x"), 1], [ext(17), 1, 1], [ext(18), 1, True], [ext(17), [1]])),
    *map(packed, ([ext(17), {}], [ext(20), 1])),
    *(packed([ext(19), 1, 2, *more]) for more in ((), (0,), ("3",), (True,))),
    # object arrays, texts and tensors of numpy's
    *map(packed, ([ext(21, b"x"), 1], [ext(21, struct.pack("<Q", 2)), 1], [ext(22), 1])),
    packed([ext(21, struct.pack("<QQ", 0, 2**63))]),
    packed([ext(21, struct.pack("<QQ", 2**63, 2)), 1]),
    *map(packed, ([ext(22)], [ext(23, b"float32")], [ext(23, b"float32"), 1.0])),
    packed([ext(23, b"qint8"), ext(1, bytes(2))]),
    packed([ext(23, b"float32"), ext(1, b"\x0b\x01" + bytes(8))]),
    # stand-ins
    *map(packed, ([ext(24), "a", "b"], [ext(24), "a", 1, 2], [ext(25), "a"])),
    *map(packed, ([ext(25), "a", b"b"], [ext(25), "a", ext(25)])),
    # values by themselves
    *map(packed, (ext(1), ext(1, b"\x0a\x01" + struct.pack("<Q", 3)), ext(2, b"\x0a"))),
    *map(packed, (ext(3, bytes(1025)), ext(4, bytes(15)), ext(5, pickle.dumps(1)))),
]


def test_malformed_messages_are_refused() -> None:
    assert not_refused(decode, MALFORMED) == []


@pytest.mark.parametrize(
    ("most", "more", "limit"),
    [
        (np.zeros(4000, np.uint8), np.zeros(5000, np.uint8), "header_bytes"),
        ([np.zeros(100_000, np.uint8)], [np.zeros(100_001, np.uint8)], "frame_bytes"),
        ([np.zeros(70_000, np.uint8)] * 2, [np.zeros(80_000, np.uint8)] * 2, "message_bytes"),
        ([np.zeros(20_000, np.uint8)] * 3, [np.zeros(20_000, np.uint8)] * 4, "frames"),
        (deep(5), deep(6), "depth"),
        (list(range(99)), list(range(100)), "items"),
        (dict.fromkeys(map(str, range(49))), dict.fromkeys(map(str, range(50))), "items"),
        ("x" * 50, "x" * 51, "text_bytes"),
        (2**126, 2**130, "int_bytes"),
    ],
)
def test_every_limit_holds(most: object, more: object, limit: str) -> None:
    """In both directions; what is just within it passes."""
    assert_same(most, decode(encode(most, limits=SMALL), limits=SMALL))
    with pytest.raises(errors.MessageTooLargeError, match=limit):
        decode(encode(more), limits=SMALL)
    with pytest.raises(errors.LocalProtocolError, match=f"{limit}|nested deeper|an integer"):
        encode(more, limits=SMALL)


def test_many_keys_that_are_no_text_are_refused() -> None:
    """Python randomises the hash of text only; other keys are limited in number."""
    limits = WireLimits(hashed_keys=100)
    assert len(decode(encode(dict.fromkeys(map(str, range(101)))), limits=limits)) == 101
    with pytest.raises(errors.MessageTooLargeError, match="hashed_keys"):
        decode(encode(dict.fromkeys(range(101), 0)), limits=limits)
    with pytest.raises(errors.MessageTooLargeError, match="hashed_keys"):
        decode(encode([set(range(70)), frozenset(range(70))]), limits=limits)


def test_colliding_keys_are_refused() -> None:
    """Keys with one and the same hash make a dict quadratic: a few may be chance, many are not."""
    prime = 2**61 - 1
    colliding = {prime * i: 0 for i in range(100)}
    assert len({hash(key) for key in colliding}) == 1
    with pytest.raises(errors.RemoteProtocolError, match="collide"):
        decode(encode(colliding))


def test_hostile_description_is_cleaned_by_the_receiver() -> None:
    remote = decode(packed([ext(25), "a\x1b]0;x\x07" * 1000, "\r\x9b31m" * 10_000]))
    assert isinstance(remote, RemoteObject)
    assert remote.type_name.isprintable()
    assert remote.text.isprintable()
    assert len(repr(remote)) < 3000


def test_what_is_looked_at_is_never_borrowed() -> None:
    """Flags, and what a thing is described by, are copies; the control, an array, lies where its
    frame does. Whoever sent them may still write there."""
    large = np.zeros(20_000)
    sent = [large, large.astype(bool), object()]
    frames = encode(sent, describer=lambda _: (GENERATOR, {"keys": (large,)}))
    frames = [frames[0], *(memoryview(bytearray(frame)) for frame in frames[1:])]
    document, tail, buffers = split_frames(frames, DEFAULT_LIMITS)
    lies = [np.frombuffer(buffer, np.uint8) for buffer in buffers]
    for borrows in (True, False):
        described: list[Any] = []

        def things(_: object, noted: list[Any] = described) -> Any:
            return lambda code, value: noted.append(value)

        decoder = Decoder(tail, buffers, DEFAULT_LIMITS, None, None, things, borrows=borrows)
        array, flags, _ = decoder.value(document)
        looked_at = [flags, described[0]["keys"][0]]
        assert [any(map(partial(np.shares_memory, one), lies)) for one in looked_at] == [False] * 2
        assert any(map(partial(np.shares_memory, array), lies)) is borrows

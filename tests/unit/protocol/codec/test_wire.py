"""The parts of the codec by themselves: frames, the look at a document, what an error names."""

from __future__ import annotations

import pickle
import threading
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from envhub_worker.protocol.codec import unsendable, wire
from envhub_worker.protocol.codec.encoder import Encoder
from envhub_worker.protocol.codec.unsendable import handed_over
from envhub_worker.protocol.codec.wire import PickledValue
from envhub_worker.protocol.errors import (
    LocalProtocolError,
    MessageTooLargeError,
    RemoteProtocolError,
)
from envhub_worker.protocol.limits import DEFAULT_LIMITS

_HEADER = wire.DOCUMENT_BYTES.pack(3) + b"doctail"


def test_a_header_is_document_and_tail() -> None:
    array = np.arange(3, dtype=np.int32)
    document, tail, rest = wire.split_frames([_HEADER, array.data], DEFAULT_LIMITS)
    assert (document, bytes(tail)) == (b"doc", b"tail")
    assert [bytes(one) for one in rest] == [array.tobytes()]


@pytest.mark.parametrize("name", ["frames", "header_bytes", "frame_bytes", "message_bytes"])
def test_each_bound_of_frames_holds_in_both_directions(name: str) -> None:
    """What comes in is too large, and what would go out is our own mistake; one less passes."""
    given, sizes = [_HEADER, b"x" * 20, b"y"], {"frames": 3, "header_bytes": len(_HEADER)}
    most = {**sizes, "frame_bytes": 20, "message_bytes": len(_HEADER) + 21}[name]
    wire.check_outgoing_frames(given, replace(DEFAULT_LIMITS, **{name: most}))
    limits = replace(DEFAULT_LIMITS, **{name: most - 1})
    with pytest.raises(MessageTooLargeError, match=name):
        wire.split_frames(given, limits)
    with pytest.raises(LocalProtocolError, match=name):
        wire.check_outgoing_frames(given, limits)


@pytest.mark.parametrize(
    "document",
    [
        b"\x91" * 1000 + b"\xc0",  # deep
        b"\xdd\xff\xff\xff\xff" + b"\xc0" * 20_000,  # four thousand million elements
        b"\xdc\x40\x00" + b"\xc0" * 0x3FFF,  # one element less than it says
        b"\xd6\xff\0\0\0\1",  # a time of msgpack's own
        b"\xc1" + b"\xc0" * 20_000,  # a byte that msgpack has no use for
    ],
)
def test_documents_without_bounds_are_refused(document: bytes) -> None:
    """Before msgpack allocates anything for them; the control is one that is as long."""
    with pytest.raises((MessageTooLargeError, RemoteProtocolError)):
        wire.check_document(document, DEFAULT_LIMITS)
    wire.check_document(msgpack.packb([None] * len(document)), DEFAULT_LIMITS)


def test_codes_are_told_apart() -> None:
    """Each extension has one of its own, in the half that msgpack leaves to applications."""
    codes = [
        value
        for name, value in vars(wire).items()
        if name.isupper() and name[0] != "_" and type(value) is int
    ]
    assert len(codes) == len(set(codes)) == 19
    assert all(0 < code < 128 for code in codes)
    for name, carrier in wire.TENSOR_DTYPES.items():
        assert np.dtype(carrier).itemsize in (1, 2, 4, 8, 16), name


def test_what_cannot_be_sent_is_named_with_its_place() -> None:
    """Of values that are nested, and of arguments; a cycle is none that is followed."""
    send = Encoder(None, DEFAULT_LIMITS).frames
    value: list[Any] = [1, {"a": 1 << 70_000}]
    text = unsendable.explain(value, TypeError("no"), DEFAULT_LIMITS, send)
    assert "[1]['a'] cannot be sent" in text
    cycle: list[Any] = []
    cycle.append(cycle)
    assert "contains itself" in unsendable.explain(cycle, TypeError("no"), DEFAULT_LIMITS, send)
    assert unsendable.explain([1], TypeError("no"), DEFAULT_LIMITS, send).endswith(
        "cannot be sent: no"
    )
    held = {"lock": [threading.Lock()]}
    error = TypeError("cannot pickle")
    assert "held['lock'][0] cannot be sent" in unsendable.unpicklable(
        "held", held, error, pickle.dumps
    )


def test_what_the_wire_carries_is_handed_over_as_it_is() -> None:
    assert handed_over([1, "a", None], pickle.dumps, DEFAULT_LIMITS) == [1, "a", None]
    made = handed_over(range, pickle.dumps, DEFAULT_LIMITS)
    assert isinstance(made, PickledValue)

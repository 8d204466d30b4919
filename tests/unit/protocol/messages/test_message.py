"""Frames of a message, and the number in front of a header. Messages that recur are unpacked by
their form: nobody may notice."""

import sys
import tracemalloc
from typing import Any
from unittest.mock import Mock

import cloudpickle
import msgpack
import numpy as np
import pytest
from hypothesis import given

from envhub_worker.protocol import errors
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.arrays import ArrayReader
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.messages import message
from tests.support import inside, wire
from tests.support.compare import assert_same
from tests.support.decode import decode
from tests.support.values import values


@pytest.fixture(autouse=True)
def no_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*inside.FORMS, message.Forms())


def changed(value: Any) -> Any:
    if type(value) in (int, float, np.float32):
        return -1 - value
    if type(value) is str:
        return f"{value}\udc80" if value else "é"
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return np.logical_not(value) if value.dtype == bool else value + 1
    if isinstance(value, (list, tuple)):
        return type(value)(map(changed, value))
    if isinstance(value, dict):
        return {key: changed(item) for key, item in value.items()}
    return value


@given(values)
def test_what_comes_again_is_packed_and_unpacked_as_the_first_time(value: Any) -> None:
    for one in (value, value, value, changed(value)):
        frames = m.pack(m.Value(one))
        assert [bytes(f) for f in frames] == [bytes(f) for f in encode([m.Value.kind, one])]
        message = m.unpack(frames)
        assert_same(decode(encode(one)), message.value)


@pytest.mark.parametrize(("one", "other"), [(1, True), (0, False), (0.0, -0.0), ("a", b"a")])
def test_what_is_equal_and_not_the_same_is_kept_apart(one: Any, other: Any) -> None:
    for value in (one, one, one, other, other, other):
        message = m.unpack(m.pack(m.Value((value,))))
        assert_same((value,), message.value)
    assert inside.forms()


MAPPED = RemoteEnum("a.E", "MAPPED", {"x": [1]})
"""A member of an enumeration whose value is a mapping: the document has that inside of a key."""


@pytest.mark.parametrize(
    "key",
    [
        *((1, 2), frozenset({1, 2}), range(3), ((), (range(2), "a")), 1.5, 2j, b"b", None),
        *(MAPPED, (MAPPED, 1), frozenset({MAPPED}), RemoteEnum("a.E", "ARRAY", np.zeros(2))),
        *(RemoteObject("a.B", "<b>"), np.int8(3), np.str_("a"), np.datetime64("2024-05-06"), 2**80),
    ],
    ids=repr,
)
def test_keys_that_are_no_text_recur(key: object) -> None:
    """Repositories count visits by ``(x, y)``: the second such message is read as the first was."""
    for number in range(4):
        message = m.unpack(m.pack(m.Value({"visits": {key: number % 2}})))
        assert message == m.Value({"visits": {key: number % 2}})


def test_a_form_that_cannot_be_made_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """For whatever reason: what was unpacked without one is so again."""
    monkeypatch.setattr(message, "Incoming", Mock(side_effect=RuntimeError))
    for _ in range(5):
        assert m.unpack(m.pack(m.Value({"a": 1}))) == m.Value({"a": 1})


def test_what_can_be_changed_of_a_recurring_message_is_the_receivers_own() -> None:
    frames = m.pack(m.Value({"a": [1]}))
    values = [m.unpack(frames).value for _ in range(4)]
    for number, value in enumerate(values):
        value["a"][:] = [number]
        value["more"] = number
    assert [value["a"] for value in values] == [[number] for number in range(4)]


def _known(value: object) -> bytes:
    for _ in range(3):
        frames = m.pack(m.Value(value))
        m.unpack(frames)
    assert inside.forms()
    [header] = frames
    return bytes(header)


@pytest.mark.parametrize("change", [lambda raw: raw[:-1], lambda raw: raw + b"x"])
def test_the_bytes_of_a_known_message_are_counted(change: Any) -> None:
    header = _known("known")
    with pytest.raises(errors.RemoteProtocolError):
        m.unpack([change(header)])
    with pytest.raises(errors.RemoteProtocolError):
        m.unpack([header, b"more"])


def test_the_limits_of_a_known_message_hold() -> None:
    value = ["a" * 20, 1]
    header = _known(value)
    with pytest.raises(errors.MessageTooLargeError):
        m.unpack([header], limits=WireLimits(header_bytes=20))
    with pytest.raises(errors.MessageTooLargeError):
        m.unpack([header], limits=WireLimits(depth=0))
    with pytest.raises(errors.LocalProtocolError):
        m.pack(m.Value(value), limits=WireLimits(header_bytes=20))


def test_a_known_header_is_read_with_any_id() -> None:
    message = m.Relay(3, "step", ((1, 1),), stepped=True)
    for number in (1, 2, 3, (1 << 63) - 1):
        [header] = m.pack_header(message, number)
        assert m.unpack_header(bytes(header)) == (number, message)
        assert m.unpack_header(memoryview(header)) == (number, message)
    with pytest.raises(errors.RemoteProtocolError):
        m.unpack_header(bytes(header) + b"x")
    with pytest.raises(errors.MessageTooLargeError):
        m.unpack_header(bytes(header), limits=WireLimits(header_bytes=20))


def test_pickled_objects_never_have_a_form() -> None:
    frames = m.pack(m.Value(_Own()), pickler=cloudpickle.dumps)
    for _ in range(3):
        message = m.unpack(frames, unpickler=cloudpickle.loads)
        assert type(message.value).__name__ == "_Own"
    for _ in range(3):
        with pytest.raises(errors.ProtocolError):
            m.unpack(frames)


class _Own:
    """Something that only a pickler can send."""


def test_a_peer_that_never_repeats_itself_fills_nothing() -> None:
    for number in range(2000):
        m.unpack(m.pack(m.Value(f"{number}")))
    assert not inside.forms()


@pytest.mark.parametrize(
    ("number", "size", "times"), [(10_000, 5, 1), (3_000, 5, 2), (20, 1 << 17, 2)]
)
def test_what_is_kept_of_a_peers_messages_has_a_bound(number: int, size: int, times: int) -> None:
    tracemalloc.start()
    for index in range(number):
        frames = wire.value(msgpack.packb(f"{index:{size}}"))
        for _ in range(times):
            m.unpack(frames)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 600_000


def test_a_form_keeps_no_array() -> None:
    """Nor the memory that it was lent from: a slot that is held is not written again."""
    header, lender = map(bytearray, m.pack(m.Value({"a": [np.zeros(50_000)]})))
    unheld = sys.getrefcount(lender)
    for _ in range(3):
        lent = m.unpack([bytes(header), memoryview(lender)], borrows=True)
        assert sys.getrefcount(lender) > unheld
        del lent
    assert inside.forms()
    assert sys.getrefcount(lender) == unheld


def test_memory_that_is_not_there_is_the_peers_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = m.pack(m.Value(np.zeros(50_000, np.uint8)))
    monkeypatch.setattr(ArrayReader, "take", Mock(side_effect=MemoryError))
    with pytest.raises(errors.MessageTooLargeError):
        m.unpack(frames)


def test_what_has_no_end_is_refused_as_without_a_form() -> None:
    cyclic: list[object] = []
    cyclic.append(cyclic)
    deep: object = 1
    for _ in range(5000):
        deep = (deep,)
    with pytest.raises(errors.LocalProtocolError, match="contains itself"):
        m.pack(m.Value({"a": cyclic}))
    with pytest.raises(errors.LocalProtocolError, match="nested deeper"):
        m.pack(m.Value({"a": deep}))

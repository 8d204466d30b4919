"""What the caller hands over arrives as it is, of exactly its type. What cannot be sent of a reply
arrives as a description, and the rest as it is."""

import functools
import threading
import types
from typing import Any

import cloudpickle
import numpy as np
import pytest

from envhub_sandbox.transport.values import framed
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import unsendable
from envhub_worker.protocol.codec.arrays import INLINE_BYTES
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from tests.support.compare import assert_identical, assert_same
from tests.support.decode import decode
from tests.support.objects import handed
from tests.support.values import objects
from tests.support.wire import deep


def frames_of(value: object) -> list[Any]:
    return [bytes(one) for one in m.pack(m.Call(1, "told", (value,), {}), pickler=framed)]


def through(value: object) -> Any:
    call = m.unpack(frames_of(value), unpickler=cloudpickle.loads)
    return call.args[0]


def test_a_value_arrives_as_it_is() -> None:
    for name, value in (handed.PLAIN | handed.PICKLED).items():
        assert_identical(value, through(value), name)


def test_what_is_called_arrives_as_it_is() -> None:
    for name, function in handed.CALLABLE.items():
        arrived = through(function)
        assert arrived(3) == function(3), name
        assert type(arrived(3)).__name__ == type(function(3)).__name__


def test_what_holds_itself_arrives_so() -> None:
    """One piece is pickled, not each leaf: what is the same object stays the same."""
    arrived = through(handed.CYCLIC)
    assert arrived[1]["self"] is arrived
    shared = bytearray(b"x")
    one, other = through([shared, shared])
    assert one is other


def test_what_the_wire_carries_is_not_pickled() -> None:
    for name, value in handed.PLAIN.items():
        assert isinstance(m.unpack(frames_of(value)), m.Call), name


def test_what_the_wire_would_change_is_pickled() -> None:
    for value in handed.PICKLED.values():
        with pytest.raises(RemoteProtocolError, match="never loaded"):
            m.unpack(frames_of(value))


def test_every_field_of_the_callers_own_arrives_as_it_is() -> None:
    value = handed.Pose(1.0, bytearray(b"x"))
    for message in (
        m.Load(1, False, {"a": value}, {"b": value}),
        m.LoadTask(1, False, {"a": value}, {"b": value}, "s", 0),
        m.Reset(1, [1], handed.OwnDict(a=value), None),
        m.Call(1, "told", (value,), {"b": value}),
        m.CallOne(1, m.ITSELF, 0, "told", (value,), {"b": value}),
        m.SetAttr(1, "note", (value, value)),
    ):
        frames = m.pack(message, pickler=framed)
        assert_identical(message, m.unpack(frames, unpickler=cloudpickle.loads), "message")


def test_what_comes_back_is_never_pickled() -> None:
    """An answer has no field that would be; a pickle in it is refused, framed or not."""
    for size in (1, 2 * INLINE_BYTES):
        frames = m.pack(m.Value(bytearray(size)), pickler=framed)
        assert isinstance(m.unpack(frames), m.Value)
        forged = m.pack(m.Value(functools.partial(print, bytes(size))), pickler=framed)
        with pytest.raises(RemoteProtocolError, match="never loaded"):
            m.unpack(forged)
    frames = frames_of(np.zeros(INLINE_BYTES, handed.STRUCTURED))
    assert len(frames) > 1
    with pytest.raises(RemoteProtocolError, match="never loaded"):
        m.unpack(frames)


def test_a_framed_pickle_is_an_array_of_bytes() -> None:
    frames = frames_of(np.zeros(INLINE_BYTES, handed.STRUCTURED))
    loaded: list[Any] = []
    header = frames[0].replace(b"\x06\x05\x81", b"\x06\x01\x81")  # int8 for uint8
    assert header != frames[0]
    with pytest.raises(RemoteProtocolError, match="not an array of bytes"):
        m.unpack([header, *frames[1:]], unpickler=loaded.append)
    assert not loaded


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (
            m.Load(1, False, None, {"camera": {"pose": [1, threading.Lock()]}}),
            r"make_env: env_kwargs\['camera'\]\['pose'\]\[1\] cannot be sent: a _thread.lock",
        ),
        (
            m.Load(1, False, None, {"camera": types.SimpleNamespace(lock=threading.Lock())}),
            r"make_env: env_kwargs\['camera'\]\.lock cannot be sent: a _thread.lock cannot",
        ),
        (m.Reset(1, None, {"level": (x for x in ())}, None), r"reset: options\['level'\] cannot"),
        (m.Call(1, "f", (1,), {"a": (x for x in ())}), r"call\('f'\): kwargs\['a'\] cannot"),
        (m.SetAttr(1, "f", (1, (x for x in ()))), r"set_attr\('f'\): values\[1\] cannot"),
        (m.Step(1, {"a": np.zeros(2, "f4,f4")}), r"step: actions\['a'\] cannot be sent: dtype"),
    ],
)
def test_what_cannot_be_sent_is_named(message: m.Message, words: str) -> None:
    with pytest.raises(LocalProtocolError, match=words) as caught:
        m.pack(message, pickler=framed)
    if message.HANDED:
        assert "Pass plain data" in str(caught.value)


@pytest.mark.parametrize(
    ("sent", "arrives"),
    [
        (np.array([(1, 2.5)], "i4,f4"), objects((1, 2.5))),
        (np.array([(1, 2)], [("a", "i4"), ("b", "i8")])[0], (1, 2)),
        (np.void(b"x"), b"x"),
        (np.array([b"ab"], "V2"), objects(b"ab")),
        (np.longdouble(1.5), np.float64(1.5)),
        (np.array([1.5], np.clongdouble), np.array([1.5], np.complex128)),
    ],
    ids=["structured", "one of it", "raw", "raws", "long double", "complex long doubles"],
)
def test_what_numpy_alone_has_arrives_as_plain_values(sent: object, arrives: object) -> None:
    assert_same(arrives, decode(encode(sent)))


def _cyclic() -> list[Any]:
    value: list[Any] = [1]
    value.append(value)
    return value


_LIMITS = WireLimits(items=2_000, text_bytes=10_000, header_bytes=100_000, frame_bytes=1 << 20)
_MOST = _LIMITS.items
_PARTS = {
    "too deep": deep(40),
    "cyclic": _cyclic(),
    "large integer": 2**10_000,
    "long text": "x" * (_LIMITS.text_bytes + 1),
    "many bytes": b"x" * _LIMITS.header_bytes,
    "long list": [0] * _MOST,
    "long lists": [[1] * (_MOST // 3)] * 4,
    "many keys": dict.fromkeys(range(_MOST), 1),
    "wide texts": np.zeros(1, "U300000"),
    "large array": np.broadcast_to(np.uint8(0), (_LIMITS.frame_bytes + 1,)),
    "large set": set(range(_MOST)),
    "two in a tuple": (deep(40), 2**10_000),
    "in an object array": objects(1, 2**10_000),
}


def _holds_one(value: Any) -> bool:
    if isinstance(value, (list, tuple, np.ndarray)):
        return any(_holds_one(one) for one in value)
    return isinstance(value, RemoteObject) and len(value.text) <= 1100


@pytest.mark.parametrize("name", _PARTS)
def test_of_a_reply_that_cannot_be_sent_the_rest_arrives(name: str) -> None:
    """A description stands in its place; where that is not asked for, it is refused."""
    message = [71, np.arange(3), {"a": 1, "part": _PARTS[name], "z": {"x": [2, "text"]}}]
    with pytest.raises(LocalProtocolError):
        encode(message, limits=_LIMITS)
    frames = encode(message, reduces=True, limits=_LIMITS)
    found = decode(frames, limits=_LIMITS)
    assert (found[0], found[1].tolist()) == (71, [0, 1, 2])
    assert (list(found[2]), found[2]["z"]) == (["a", "part", "z"], {"x": [2, "text"]})
    assert _holds_one(found[2]["part"])


def test_a_field_itself_is_never_a_description() -> None:
    infos = dict.fromkeys(range(_MOST), 1)
    with pytest.raises(LocalProtocolError, match="items"):
        encode([71, infos], reduces=True, limits=_LIMITS)
    assert type(unsendable.reduced([71, {}], lambda _: None, DEFAULT_LIMITS)[1]) is dict


class _UntoldError(Exception):
    def __str__(self) -> str:
        raise RuntimeError


class _Untold:
    __dlpack__ = None

    def __array__(self) -> Any:
        raise _UntoldError


def test_a_part_whose_error_has_no_text_does_not_lose_the_rest() -> None:
    found = decode(encode([71, {"part": _Untold(), "z": 1}], reduces=True))
    assert type(found[1].pop("part")) is RemoteObject
    assert found[1] == {"z": 1}

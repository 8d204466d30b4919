"""What cannot be sent of a reply arrives as a description, and the rest as it is."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from envhub_worker.protocol.codec import reduced
from envhub_worker.protocol.codec.codec import RemoteObject, decode, encode
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from tests.support.compare import assert_same
from tests.support.wire import deep


def _objects(*items: Any) -> np.ndarray[Any, Any]:
    array = np.empty(len(items), dtype=object)
    for index, item in enumerate(items):
        array[index] = item
    return array


@pytest.mark.parametrize(
    ("sent", "arrives"),
    [
        (np.array([(1, 2.5)], "i4,f4"), _objects((1, 2.5))),
        (np.array([(1, 2)], [("a", "i4"), ("b", "i8")])[0], (1, 2)),
        (np.void(b"x"), b"x"),
        (np.array([b"ab"], "V2"), _objects(b"ab")),
        (np.longdouble(1.5), np.float64(1.5)),
        (np.array([1.5], np.clongdouble), np.array([1.5], np.complex128)),
    ],
    ids=["structured", "one of it", "raw", "raws", "long double", "complex long doubles"],
)
def test_what_numpy_alone_has_arrives_as_plain_values(sent: object, arrives: object) -> None:
    """Structured elements as tuples, raw ones as bytes, long doubles as doubles."""
    assert_same(arrives, decode(encode(sent)))


def _cyclic() -> list[Any]:
    value: list[Any] = [1]
    value.append(value)
    return value


_MOST = DEFAULT_LIMITS.items
_PARTS = {
    "too deep": deep(40),
    "cyclic": _cyclic(),
    "large integer": 2**10_000,
    "long text": "x" * (DEFAULT_LIMITS.text_bytes + 1),
    "many bytes": b"x" * DEFAULT_LIMITS.header_bytes,
    "long list": [0] * _MOST,
    "long lists": [[1] * (_MOST // 3)] * 4,
    "many keys": dict.fromkeys(range(_MOST), 1),
    "wide texts": np.zeros(1, "U300000"),
    "large array": np.broadcast_to(np.uint8(0), (DEFAULT_LIMITS.frame_bytes + 1,)),
    "large set": set(range(_MOST)),
    "two in a tuple": (deep(40), 2**10_000),
    "in an object array": _objects(1, 2**10_000),
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
        encode(message)
    found = cast("list[Any]", decode(encode(message, reduces=True)))
    assert (found[0], found[1].tolist()) == (71, [0, 1, 2])
    assert list(found[2]) == ["a", "part", "z"]
    assert found[2]["z"] == {"x": [2, "text"]}
    assert _holds_one(found[2]["part"])


def test_a_field_itself_is_never_a_description() -> None:
    """The message would be none any more: then it is refused as before."""
    infos = dict.fromkeys(range(_MOST), 1)
    with pytest.raises(LocalProtocolError, match="items"):
        encode([71, infos], reduces=True)
    assert type(reduced.reduced([71, {}], lambda _: True, DEFAULT_LIMITS)[1]) is dict

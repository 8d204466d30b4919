"""Plain documents are read and written without numpy, and as the codec does."""

from __future__ import annotations

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

import envhub_worker
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import plain
from envhub_worker.protocol.codec.codec import decode, encode
from envhub_worker.protocol.codec.frames import split
from envhub_worker.protocol.errors import EnvHubError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from tests.support.compare import assert_same

LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]))
    | st.binary()
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(st.text("ab", max_size=3), inner, max_size=4)
    ),
    max_leaves=12,
)
OTHERS = [
    {1, 2},
    2**70,
    1j,
    range(3),
    "\udc80",
    object(),
    dict.fromkeys(range(65), 0),
    [[[1, {2}]]],
]
SMALL = WireLimits(header_bytes=64, text_bytes=32, items=8, depth=3)


def document_of(value: object) -> bytes:
    """Its document, as the codec writes it."""
    return split(encode(value), DEFAULT_LIMITS)[0]


@given(VALUES)
def test_plain_values_are_the_codecs(value: object) -> None:
    """Byte for byte, and back."""
    assert [plain.encode(value, DEFAULT_LIMITS)] == encode(value)
    assert_same(plain.decode(document_of(value), DEFAULT_LIMITS), value)


@pytest.mark.parametrize("value", OTHERS, ids=range(len(OTHERS)))
def test_what_is_not_plain_is_the_codecs(value: object) -> None:
    """Neither is guessed at."""
    if type(value) is not dict:
        assert plain.encode(value, DEFAULT_LIMITS) is None
    if type(value) is not str:  # it arrives as another text, which is plain
        assert plain.decode(document_of(value), DEFAULT_LIMITS) is plain.NOT_PLAIN


@given(st.binary(max_size=80))
def test_noise_is_taken_for_nothing_that_the_codec_does_not_read(noise: bytes) -> None:
    """The same value, or an error, or a shrug."""
    try:
        found = plain.decode(noise, SMALL)
    except EnvHubError as error:
        with pytest.raises(type(error)):
            decode([len(noise).to_bytes(4, "little") + noise], limits=SMALL)
        return
    if found is not plain.NOT_PLAIN:
        frame = len(noise).to_bytes(4, "little") + noise
        assert repr(found) == repr(decode([frame], limits=SMALL))


@pytest.mark.parametrize("value", ["x" * 33, list(range(9)), [[[[1]]]], b"x" * 64], ids=repr)
def test_limits_are_the_codecs(value: object) -> None:
    """What is over them is not written; what is too deep, long or numerous is refused."""
    assert plain.encode(value, SMALL) is None
    with pytest.raises(EnvHubError):
        encode(value, limits=SMALL)


PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
import envhub_worker.server
from envhub_worker.protocol import messages as m
for _ in range(3):
    for said in (
        m.Hello(m.VERSION, bytes(16)),
        m.OpenJail("a/b@c:env.py", "", "", "/s", "env.py", {"limits": {"processes": 5}}, 2),
        m.JailOpened(3, (1, 2), ({"layer": "seccomp", "enforced": True, "detail": "x"},)),
        m.Relay(3, "step", ((1, 2), (2, 1))),
        m.Died(1, "signal", None, "SIGKILL", "", "last words", "step"),
    ):
        assert m.unpack(m.pack(said)) == said
        [frame] = m.pack_header(said, 7)
        assert m.unpack_header(frame) == (7, said)
print("numpy" in sys.modules)
assert m.unpack(m.pack(m.Value({1, 2}))) == m.Value({1, 2})
print("numpy" in sys.modules)
"""


def test_a_server_does_without_numpy_until_it_is_sent_something_else() -> None:
    """Its own conversation is plain."""
    folder = envhub_worker.__file__.rsplit("/envhub_worker/", 1)[0]
    command = [sys.executable, "-I", "-c", PROGRAM, folder]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "True"]


def test_messages_of_a_server_are_the_same_with_numpy() -> None:
    """The other way of the program above."""
    said = m.Died(1, "signal", None, "SIGKILL", "", "last words", "step")
    value = [said.kind, *said.__dict__.values()]
    assert [plain.encode(value, DEFAULT_LIMITS)] == m.pack(said)

"""The decoder against a peer that wants it to run code, hang, or eat all memory.
Whatever comes, it either decodes or raises ``RemoteProtocolError``; it executes nothing, and
stays within the memory and time of a message that is allowed. ``test_fuzz`` spoils what real
workers say, descriptions of spaces among it."""

import json
import os
import pickle
import random
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.spaces.spaces import encode_space
from tests.attacks.protocol import decoder_bombs
from tests.attacks.protocol.decoder_bombs import ACCEPTED, MIB, REFUSED
from tests.fuzz.mutate import Pairs, Spoiler
from tests.fuzz.mutate import packed as packed_tree
from tests.support.decode import decode
from tests.support.wire import decode_space, ext, message, packed

ROOT = Path(__file__).parents[3]
FUZZ = settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
PEAK_BYTES = 64 * MIB
SAMPLE: list[Any] = [
    "step", 17, {"a": 1.5, 2: (None, True), (3, "x"): b"bytes"}, {1, 2}, frozenset(["y"]),
    range(3), slice(1, None), 2**80, 1 + 2j, np.float32(2.5), np.bool_(True), np.str_("text"),
    np.arange(6, dtype="f4").reshape(2, 3), np.array([True, False]), np.array(["ab", "c"]),
    np.array(["2020-01-01"], "M8[D]"), np.zeros((0, 4)), np.zeros(20_000, "u1"), np.ones(5000),
    np.array([[1, "a"], [None, (2,)]], dtype=object), RemoteObject("a.B", "<b>"),
    encode_space(spaces.Dict({"x": spaces.Box(0, 1, (2,)), "y": spaces.Text(3)})),
]  # fmt: skip
FRAMES = [bytes(frame) for frame in encode(SAMPLE)]


def attempt(frames: list[Buffer]) -> None:
    try:
        value = decode(frames)
    except RemoteProtocolError:
        return
    # No half-built thing may leak: all that is decoded has a form on the wire, and a repr.
    assert "_Head" not in repr(value)
    encode(value)


def test_the_sample_itself_decodes() -> None:
    assert decode(FRAMES)[:2] == ["step", 17]


@pytest.mark.parametrize("seed", range(10))
def test_spoiled_messages_are_decoded_or_refused(seed: int) -> None:
    """A valid message with every kind of value in it: its document, bytes or frames changed."""
    spoiler = Spoiler(random.Random(seed), SAMPLE)
    frames = FRAMES
    for number in range(100):
        frames = spoiler.frames(FRAMES if number % 3 == 0 else frames, [FRAMES])
        attempt(frames)


# --- well-formed msgpack with hostile contents --------------------------------------------------


codes = st.sampled_from([*range(8), *range(14, 30), 127])
descriptors = st.builds(
    lambda code, flags, parameter, shape: (
        bytes((code, flags))
        + (struct.pack("<I", parameter) if parameter is not None else b"")
        + struct.pack(f"<{len(shape)}Q", *shape)
    ),
    st.integers(0, 20),
    st.integers(0, 5) | st.integers(0x80, 0x85),
    st.none() | st.integers(0, 2**32 - 1),
    st.lists(st.integers(0, 4) | st.integers(0, 2**64 - 1), max_size=5),
)
payloads = st.binary(max_size=24) | descriptors | st.sampled_from([b"float32", b"bfloat16"])
extensions = st.builds(msgpack.ExtType, codes, payloads)
heads = st.builds(msgpack.ExtType, st.integers(16, 26), st.just(b"") | payloads)
leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5)
    | extensions
)
documents = st.recursive(
    leaves,
    lambda children: (
        st.lists(children, max_size=4)
        | st.builds(lambda head, rest: [head, *rest], heads, st.lists(children, max_size=4))
        | st.lists(st.tuples(children, children), max_size=3).map(Pairs)
    ),
    max_leaves=25,
)


@FUZZ
@given(documents, st.binary(max_size=64), st.lists(st.binary(max_size=32), max_size=3))
@example([ext(16), ext(16)], b"", [])
@example([ext(24), "a", "b", ext(17)], b"", [])
def test_hostile_documents_decode_or_fail(document: Any, tail: bytes, frames: list[bytes]) -> None:
    """Extensions with any payload in any place, maps with any keys, arrays with any descriptor."""
    attempt(message(packed_tree(document), tail, *frames))


# --- bombs --------------------------------------------------------------------------------------


def explode(*arguments: str) -> dict[str, dict[str, Any]]:
    run = subprocess.run(
        [sys.executable, "-m", decoder_bombs.__name__, *arguments],
        cwd=ROOT,
        # what is freed goes back to the kernel at once, and is measured where it is taken again
        env={**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"},
        capture_output=True,
        text=True,
        timeout=280,
    )
    reports = {one["name"]: one for one in map(json.loads, run.stdout.splitlines())}
    assert run.returncode == 0, f"after {list(reports)}: {run.returncode} {run.stderr}"
    return reports


def test_bombs_explode_without_the_decoder() -> None:
    """The control: msgpack alone, under the same limits, is blown up by the first bomb."""
    [report] = explode("plain").values()
    assert report["outcome"].startswith("MemoryError") or report["peak"] > 4 * PEAK_BYTES


def test_bombs_cost_no_more_than_a_message_may() -> None:
    """Each is refused for what it is; what stays just within the limits decodes."""
    reports = explode()
    assert list(reports) == [*REFUSED, *ACCEPTED]
    for name, report in reports.items():
        assert report["peak"] < PEAK_BYTES, report
        assert "memory" not in report["outcome"], report
        if name in ACCEPTED:
            assert report["outcome"] == "decoded", report
        else:
            kind = report["outcome"].partition(":")[0]
            assert kind in ("RemoteProtocolError", "MessageTooLargeError"), report


# --- code ---------------------------------------------------------------------------------------


class Canary:
    """An object whose unpickling writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, "sung")


def smuggled(song: bytes) -> list[list[Buffer]]:
    """Messages with a pickle in every place where bytes can be."""
    flat = struct.pack("<Q", len(song))
    singles = [packed(song), packed({song: song}), message(song), [song], [song, song]]
    arrays = [
        message(msgpack.packb(ext(1, bytes((code, flags)) + parameter + flat)), tail, *frames)
        for code in (*range(20), 255)
        for parameter in (b"", struct.pack("<I", 1), struct.pack("<I", len(song)))
        for flags, tail, frames in ((1, song, []), (0x81, b"", [song]))
    ]
    alone = [packed(ext(code, song)) for code in range(128)]
    heading = [packed([ext(code, song), song, song]) for code in range(128)]
    headed = [packed([ext(code), *[song] * count]) for code in range(16, 27) for count in (1, 2, 3)]
    objects = [packed([ext(21, struct.pack("<Q", 1)), ext(code, song)]) for code in range(30)]
    negative = [message(b"\xc9" + struct.pack(">I", len(song)) + b"\xff" + song)]
    return [*singles, *arrays, *alone, *heading, *headed, *objects, *negative]


def test_pickles_never_execute(tmp_path: Path) -> None:
    """A pickle in any extension, array, frame or text is data or an error, and never runs.
    The control: the same bytes do run in ``pickle.loads``, before and after."""
    before, canary, after = (tmp_path / name for name in ("before", "canary", "after"))
    pickle.loads(pickle.dumps(Canary(before)))
    song = pickle.dumps(Canary(canary))
    for frames in smuggled(song):
        attempt(frames)
    assert not canary.exists()
    pickle.loads(pickle.dumps(Canary(after)))
    assert before.exists()
    assert after.exists()


def test_pickled_spaces_never_execute(tmp_path: Path) -> None:
    """A pickle in place of any attribute of a space is refused, and never runs."""
    canary = tmp_path / "canary"
    song = pickle.dumps(Canary(canary))
    value = encode_space(spaces.Box(0, 1, (2,)))
    for name in value:
        for smuggled_value in (song, [song], np.frombuffer(song, "u1"), Canary(canary)):
            with pytest.raises(RemoteProtocolError):
                decode_space(value | {name: smuggled_value}, max_elements=1000)
    assert not canary.exists()

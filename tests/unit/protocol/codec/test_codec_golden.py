"""The bytes of every kind of value, kept: other versions must read them."""

import json
from pathlib import Path

import numpy as np

from envhub_worker.protocol.codec.arrays import INLINE_BYTES
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.codec.wire import Buffer
from tests.support.compare import assert_same
from tests.support.decode import decode

GOLDEN = Path(__file__).parents[2] / "golden" / "values.json"
GOLDEN_VALUES = {
    "none": None,
    "bool": [True, False],
    "int": [0, -1, 127, 2**32, -(2**63), 2**64 - 1],
    "big int": [2**64, -(2**70)],
    "float": [1.5, float("-inf")],
    "complex": 1 - 2j,
    "text": ["", "aé\U0001f600"],
    "bytes": b"\0\xff",
    "list": [[], [1]],
    "tuple": ((), (1, (2,))),
    "dict": {"a": 1, 2: {}, (3, None): b"k"},
    "set": [{1}, frozenset(["x"]), set()],
    "range": range(1, 9, 2),
    "slice": slice(None, 3),
    "numpy scalar": [np.float32(1.5), np.int64(-2), np.bool_(True), np.datetime64(3, "s")],
    "numpy text": [np.str_("a"), np.bytes_(b"b")],
    "array": np.arange(6, dtype="f4").reshape(2, 3),
    "0-d array": np.array(7, dtype="i2"),
    "empty array": np.zeros((0, 3), dtype="u1"),
    "text array": np.array(["ab", "c"]),
    "time array": np.array([5], dtype="m8[25ms]"),
    "arrays in order": {"x": np.array([1], "u1"), "y": [np.array([2, 3], "u2"), True]},
    "large array": np.full(INLINE_BYTES + 1, 7, dtype="u1"),
    "object array": np.array([[None, "a"]], dtype=object),
    "enum": RemoteEnum("a.Colour", "RED", 3),
    "object": RemoteObject("a.Thing", "<thing>"),
}


def short(frames: list[Buffer]) -> list[str]:
    """Frames as hexadecimal text; uniform ones as their byte and length."""
    texts = []
    for frame in map(bytes, frames):
        uniform = len(frame) > 100 and len(set(frame)) == 1
        texts.append(f"{frame[:1].hex()} x {len(frame)}" if uniform else frame.hex())
    return texts


def test_golden_bytes_are_what_is_written() -> None:
    written = {name: short(encode(value)) for name, value in GOLDEN_VALUES.items()}
    assert written == json.loads(GOLDEN.read_text())


def test_golden_bytes_are_read() -> None:
    for name, texts in json.loads(GOLDEN.read_text()).items():
        frames = []
        for text in texts:
            byte, _, count = text.partition(" x ")
            frames.append(bytes.fromhex(byte) * int(count or 1))
        assert_same(GOLDEN_VALUES[name], decode(frames), name)

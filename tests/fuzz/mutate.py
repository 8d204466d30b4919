"""Spoiled values, documents and bytes; everything comes from one seeded generator."""

import random
import struct
from typing import Any

import msgpack
import numpy as np

from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.limits import WireLimits
from tests.support.decode import decode

SMALL = WireLimits(items=20_000, header_bytes=1 << 20)
_NUMBERS = (0, 1, -1, 2, 7, 2**31, 2**63 - 1, -(2**63), 2**64 - 1, 2**200)
_FLOATS = (0.0, -0.0, 1.5, float("nan"), float("inf"), -6e4)
_TEXTS = ("", "a", "_a", "final_obs", "_final_obs", "\x1b[2J", "x" * 600, "bit_generator", "é\0")
_KEYS = (
    *(0, -1, None, True, 1.5, 2j, b"b", range(3), 2**80, np.int8(3), np.str_("a")),
    *(np.datetime64("2024-05-06"), RemoteObject("a.B", "c"), RemoteEnum("a.E", "L", [1])),
)
_DTYPES = ("?", "i1", "u1", "i4", "i8", "u8", "f2", "f4", "f8", "c16", "U3", "S2", "M8[s]", "O")
_SHAPES = ((), (0,), (1,), (2,), (3,), (4,), (3, 1), (0, 2**20), (2, 2), (3, 0), (1,) * 32)


def _member(value: object) -> RemoteEnum:
    """A member of an enumeration, whose value need not be one that can be hashed."""
    return RemoteEnum("a.E", "M", value)


class Spoiler:
    """Makes junk, and puts it where something else was."""

    def __init__(self, rng: random.Random, donors: list[Any]) -> None:
        self.rng, self.donors = rng, donors

    # --- values --------------------------------------------------------------------------------

    def value(self, value: Any, depth: int = 0) -> Any:
        """A value with something in it spoiled."""
        rng = self.rng
        if depth < 12 and rng.random() < 0.8:
            if type(value) is dict and value:
                return self._in_dict(value, depth)
            if type(value) in (list, tuple) and value:
                items = list(value)
                self._in_list(items, depth)
                return type(value)(items)
            if type(value) is np.ndarray and value.dtype == object and value.size:
                made = value.copy()
                index = rng.randrange(made.size)
                made.reshape(-1)[index] = self.value(value.reshape(-1)[index], depth + 1)
                return made
        if type(value) is np.ndarray and rng.random() < 0.8:
            return self._array(value)
        if type(value) is int and rng.random() < 0.7:
            return value + rng.choice((-1, 1, 2**20, -(2**20), 2**40))
        return self.junk(depth)

    def _in_dict(self, value: dict[Any, Any], depth: int) -> dict[Any, Any]:
        made, rng = dict(value), self.rng
        key = rng.choice(list(made))
        act = rng.random()
        if act < 0.08:
            del made[key]
        elif act < 0.16:
            made[self.key()] = made.pop(key)
        elif act < 0.24:
            made[self.key()] = self.junk(depth + 1)
        else:
            made[key] = self.value(made[key], depth + 1)
        return made

    def _in_list(self, items: list[Any], depth: int) -> None:
        index, act = self.rng.randrange(len(items)), self.rng.random()
        if act < 0.08:
            del items[index]
        elif act < 0.16:
            items.insert(index, items[index])
        else:
            items[index] = self.value(items[index], depth + 1)

    def _array(self, array: Any) -> Any:
        rng = self.rng
        act = rng.randrange(7)
        if act == 0 and array.dtype.kind in "biuf":
            return array.astype(rng.choice(_DTYPES[:9]))
        if act == 1:
            return array[..., None]
        if act == 2:
            return array.reshape(-1)
        if act == 3 and array.ndim:
            return array[: max(0, len(array) - 1)]
        if act == 4 and array.ndim:
            return np.concatenate([array, array[:1]])
        if act == 5 and array.size and array.dtype.kind in "biuf":
            made = array.copy()
            made.reshape(-1)[rng.randrange(made.size)] = rng.choice((0, 1))
            return made
        return self.array()

    def array(self) -> Any:
        shape = self.rng.choice(_SHAPES)
        made = np.zeros(shape, self.rng.choice(_DTYPES))
        if made.dtype.kind in "iuf" and made.size:
            made.reshape(-1)[:] = self.rng.choice((0, 1, 100))
        return made

    def key(self) -> Any:
        """Anything that can be a key."""
        made = self.rng.choice((*_TEXTS, *_KEYS))
        while self.rng.random() < 0.3:
            made = self.rng.choice(((made, 1), frozenset({made}), ((),), _member({made: made})))
        return made

    def junk(self, depth: int = 0) -> Any:
        rng, act = self.rng, self.rng.randrange(14)
        if act == 0 and self.donors:
            return rng.choice(self.donors)
        if act == 1:
            return rng.choice(_NUMBERS)
        if act == 2:
            return rng.choice(_FLOATS)
        if act == 3:
            return rng.choice(_TEXTS)
        if act in (4, 5):
            return self.array()
        if act == 6 and depth < 12:
            return [self.junk(depth + 1) for _ in range(rng.randrange(4))]
        if act == 7 and depth < 12:
            return tuple(self.junk(depth + 1) for _ in range(rng.randrange(4)))
        if act == 8 and depth < 12:
            return {self.key(): self.junk(depth + 1) for _ in range(rng.randrange(4))}
        if act == 9:
            return rng.choice(
                (set(), {1, "a"}, frozenset({(1, 2)}), range(0, -9, -2), slice(1, None))
            )
        if act == 10:
            return rng.choice((RemoteObject("a.B", "<b>"), RemoteEnum("a.E", "M", {"x": 1})))
        if act == 11:
            return np.array(rng.choice(_FLOATS), rng.choice(("f2", "f4", "f8")))[()]
        return rng.choice((None, True, False, b"", b"\xff" * 9, 1 + 2j))

    # --- documents -----------------------------------------------------------------------------

    def frames(self, frames: list[bytes], others: list[list[bytes]]) -> list[bytes]:
        """A message with its document, its arrays' bytes or its frames spoiled."""
        rng = self.rng
        header, *buffers = frames
        size = int.from_bytes(header[:4], "little")
        document, tail = header[4 : 4 + size], header[4 + size :]
        act = rng.random()
        if act < 0.6:
            document = self._document(document, others)
        elif act < 0.75:
            document = self.raw(document)
        elif act < 0.9:
            tail = self.raw(tail)
        else:
            buffers = [*buffers, rng.choice(others)[0]] if rng.random() < 0.5 else buffers[:-1]
            buffers = [self.raw(one) if rng.random() < 0.3 else one for one in buffers]
        declared = len(document) if rng.random() < 0.97 else rng.choice((0, 2**32 - 1, size + 1))
        declared &= 2**32 - 1  # a spoiled message, spoiled again, may say more already
        return [struct.pack("<I", declared) + document + tail, *buffers]

    def _document(self, document: bytes, others: list[list[bytes]]) -> bytes:
        try:
            tree = _tree(document)
            donor = rng_part(self.rng, _tree(_document_of(self.rng.choice(others))))
        except Exception:  # spoiled before
            return self.raw(document)
        return packed(self._tree(tree, donor, 0))

    def _tree(self, tree: Any, donor: Any, depth: int) -> Any:
        rng = self.rng
        if isinstance(tree, list) and tree and depth < 30 and rng.random() < 0.85:
            made = type(tree)(tree)
            index, act = rng.randrange(len(made)), rng.random()
            if isinstance(made, Pairs):
                place = rng.randrange(2)
                pair = list(made[index])
                pair[place] = self._tree(pair[place], donor, depth + 1)
                made[index] = tuple(pair)
                if act < 0.1:
                    made.append(made[index])
            elif act < 0.1:
                del made[index]
            elif act < 0.2:
                made.insert(index, made[index])
            else:
                made[index] = self._tree(made[index], donor, depth + 1)
            return made
        if isinstance(tree, msgpack.ExtType) and rng.random() < 0.7:
            code = tree.code if rng.random() < 0.6 else rng.choice((1, 2, 3, 4, 5, *range(16, 27)))
            return msgpack.ExtType(code, self.raw(tree.data) if rng.random() < 0.8 else tree.data)
        if rng.random() < 0.4:
            return donor
        return (
            _tree(bytes(encode(self.junk(6), limits=SMALL)[0])[4:][: 1 << 16])
            if rng.random() < 0.5
            else rng.choice((None, True, *_NUMBERS[:9], "", "a", b"", 1.5))
        )

    def raw(self, data: bytes) -> bytes:
        rng, made = self.rng, bytearray(data)
        for _ in range(rng.randrange(1, 4)):
            at = rng.randrange(len(made) + 1)
            act = rng.randrange(5)
            if act == 0 and at < len(made):
                made[at] ^= 1 << rng.randrange(8)
            elif act == 1 and at < len(made):
                made[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, 0xC7, 0xDD, 0xDF))
            elif act == 2:
                made[at:at] = rng.randbytes(rng.randrange(1, 9))
            elif act == 3:
                del made[at : at + rng.randrange(1, 9)]
            else:
                made[at:at] = made[at : at + rng.randrange(1, 64)]
        return bytes(made)


class Pairs(list[tuple[Any, Any]]):
    """A map whose keys may be anything, and may come twice."""


def rng_part(rng: random.Random, tree: Any) -> Any:
    while isinstance(tree, list) and tree and rng.random() < 0.7:
        tree = rng.choice(tree)
        tree = rng.choice(tree) if isinstance(tree, tuple) and len(tree) == 2 else tree
    return tree


def _document_of(frames: list[bytes]) -> bytes:
    return frames[0][4 : 4 + int.from_bytes(frames[0][:4], "little")]


def _tree(document: bytes) -> Any:
    unpacker = msgpack.Unpacker(strict_map_key=False, object_pairs_hook=Pairs)
    unpacker.feed(document)
    return unpacker.unpack()


def packed(value: Any) -> bytes:
    """Packs what no dict can hold."""
    if isinstance(value, Pairs):
        content = b"".join(packed(part) for pair in value for part in pair)
        return b"\xdf" + struct.pack(">I", len(value)) + content
    if isinstance(value, list):
        return b"\xdd" + struct.pack(">I", len(value)) + b"".join(map(packed, value))
    return bytes(msgpack.packb(value))


def wire(value: Any) -> Any:
    """A value as it arrives; None of it crosses that has no form."""
    return decode(encode(value, limits=SMALL))


def crossing(value: Any) -> tuple[bool, Any]:
    """Whether a value crosses, and what arrives."""
    try:
        return True, wire(value)
    except ProtocolError:
        return False, None

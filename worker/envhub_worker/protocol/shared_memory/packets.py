"""The frames of a message in a slab: their number, their lengths, then each at a cache line.

A cache line is aligned for every dtype, so an array can be used in place, without a copy.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any

from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.shared_memory.words import LINE
from envhub_worker.protocol.stream import check_lengths

_COUNT = struct.Struct("<Q")


def array_start(frames: Sequence[Buffer], nbytes: int) -> int:
    """The offset, in a packet, of the bytes of a message's only array."""
    lengths = _lengths(frames)
    starts = _starts(lengths)
    return starts[1] if len(lengths) > 1 else starts[0] + lengths[0] - nbytes


@lru_cache(maxsize=64)
def _starts(lengths: tuple[int, ...]) -> tuple[int, ...]:
    """The offset of each frame, and of the end of the last."""
    sizes = [_COUNT.size * (1 + len(lengths)), *lengths]
    return tuple(accumulate(-(-size // LINE) * LINE for size in sizes))


def _lengths(frames: Sequence[Buffer]) -> tuple[int, ...]:
    return tuple([memoryview(frame).nbytes for frame in frames])


def packet_bytes(frames: Sequence[Buffer]) -> int:
    """The size of a packet of frames."""
    return _starts(_lengths(frames))[-1]


def write_packet(memory: Any, start: int, room: int, frames: Sequence[Buffer]) -> int:
    """Write frames into a slab; returns the bytes that they take, or 0 if there is no room."""
    lengths = _lengths(frames)
    starts = _starts(lengths)
    if starts[-1] > room:
        return 0
    head = struct.pack(f"<{1 + len(lengths)}Q", len(lengths), *lengths)
    memory[start : start + len(head)] = head
    for offset, length, frame in zip(starts, lengths, frames, strict=False):
        memory[start + offset : start + offset + length] = frame
    return starts[-1]


def read_packet(memory: memoryview, limits: WireLimits) -> list[Buffer]:
    """Returns the frames of a packet; all but the first are views of the slab.

    Trust: input from a peer that may write meanwhile, so each number is read once.
    Raises ``RemoteProtocolError``: the area holds no packet within the limits.
    """
    count = _COUNT.unpack_from(memory)[0] if len(memory) >= _COUNT.size else 0
    if not 1 <= count <= min(limits.frames, len(memory) // _COUNT.size - 1):
        raise RemoteProtocolError(f"a packet of {count} frames is outside 1..the limit")
    lengths = struct.unpack_from(f"<{count}Q", memory, _COUNT.size)
    check_lengths(lengths, limits)
    starts = _starts(lengths)
    if starts[-1] != len(memory):
        raise RemoteProtocolError("this is not one packet")
    pairs = zip(starts, lengths, strict=False)
    header, *buffers = [memory[start : start + length] for start, length in pairs]
    return [bytes(header), *buffers]

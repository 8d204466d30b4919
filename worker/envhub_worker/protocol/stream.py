"""Length-prefixed frames on the stream between the server and a jail's runner. No I/O here.

A packet is ``count: u64, request id: u64``, then ``count`` lengths as ``u64``, then
the frames. The reader checks every number before it allocates: the peer is hostile.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits

_PREFIX = struct.Struct("<QQ")
_MAX_ID = 2**63


class Packet(NamedTuple):
    """The frames of one message, and the id of the request that they belong to."""

    request_id: int
    frames: list[Buffer]


_SMALL_CHUNK = 1 << 16
_LARGE_CHUNK = 1 << 20


def pack_packet(request_id: int, frames: Sequence[Buffer]) -> list[Buffer]:
    """The buffers to write, in order; large frames are not copied."""
    lengths = [memoryview(frame).nbytes for frame in frames]
    head = _PREFIX.pack(len(frames), request_id)
    return [head + struct.pack(f"<{len(lengths)}Q", *lengths), *frames]


def _whole(
    data: memoryview, limits: WireLimits, check: Callable[[int], None] | None
) -> tuple[int, Packet | None]:
    """Returns the first packet's size and the packet, not copied; ``(0, None)`` if incomplete."""
    end = _head_bytes(data, limits)
    if data.nbytes < end:
        return 0, None
    request_id, lengths = _read_head(data, end, limits, check)
    size = end + sum(lengths)
    if data.nbytes < size:
        return 0, None
    return size, Packet(request_id, _cut(data[end:], lengths))


def _cut(body: memoryview, lengths: tuple[int, ...]) -> list[Buffer]:
    """The frames in a packet's body."""
    frames: list[Buffer] = []
    start = 0
    for length in lengths:
        frames.append(body[start : start + length])
        start += length
    return frames


def _head_bytes(data: memoryview | bytearray, limits: WireLimits) -> int:
    """Returns the length of the head; of its fixed part while the number of frames is missing."""
    if len(data) < _PREFIX.size:
        return _PREFIX.size
    count, request_id = _PREFIX.unpack_from(data)
    if count == 0 or count > limits.frames or request_id >= _MAX_ID:
        raise RemoteProtocolError(f"a packet of {count} frames is outside 1..the limit")
    return _PREFIX.size + 8 * int(count)


def _read_head(
    data: memoryview | bytearray, size: int, limits: WireLimits, check: Callable[[int], None] | None
) -> tuple[int, tuple[int, ...]]:
    """Returns the request id and the frames' lengths of a complete head."""
    request_id = _PREFIX.unpack_from(data)[1]
    if check is not None:
        check(request_id)
    lengths = struct.unpack_from(f"<{(size - _PREFIX.size) // 8}Q", data, _PREFIX.size)
    check_lengths(lengths, limits)
    return request_id, lengths


def check_lengths(lengths: tuple[int, ...], limits: WireLimits) -> None:
    """Whether a message may have frames of these lengths. Raises ``MessageTooLargeError``."""
    if lengths[0] > limits.header_bytes:
        raise MessageTooLargeError(
            f"a header of {lengths[0]} bytes is over the limit of {limits.header_bytes}"
        )
    largest = max(lengths)
    if largest > limits.frame_bytes or sum(lengths) > limits.message_bytes:
        raise MessageTooLargeError(
            f"a message of {sum(lengths)} bytes (largest frame {largest}) is over the limit of "
            f"{limits.message_bytes} (a frame: {limits.frame_bytes})"
        )


def _space(size: int) -> memoryview:
    """Memory for a body. Large ones are mapped lazily: a merely declared length costs little."""
    if size <= _SMALL_CHUNK:
        return memoryview(bytearray(size))
    import numpy as np  # which maps large blocks lazily, and which a server may never need

    return np.empty(size, np.uint8).data


class StreamReader:
    """Cuts a byte stream into packets.

    Args:
        limits: Bounds on a packet.
        check: Refuses the id of an unexpected packet before anything is allocated for it.
    """

    def __init__(
        self, limits: WireLimits = DEFAULT_LIMITS, check: Callable[[int], None] | None = None
    ) -> None:
        self._limits = limits
        self._check = check
        self._pending = bytearray()
        self._head: tuple[int, tuple[int, ...]] | None = None
        self._body: memoryview | None = None
        self._filled = 0

    @property
    def chunk(self) -> int:
        """Returns how many bytes to read next: few at first, for most packets are small."""
        missing = 0 if self._body is None else self._body.nbytes - self._filled
        return min(max(missing, _SMALL_CHUNK), _LARGE_CHUNK)

    @property
    def room(self) -> memoryview | None:
        """Where the next bytes belong, if a packet has begun: read into it, then call ``filled``.
        So a large packet is copied once, out of the stream.
        """
        return None if self._body is None else self._body[self._filled :][:_LARGE_CHUNK]

    def filled(self, size: int) -> Iterator[Packet]:
        """Count bytes that were read into ``room``; yields the packet that they complete."""
        self._filled += size
        if self._body_is_complete():
            yield self._take()

    def feed(self, data: Buffer) -> Iterator[Packet]:
        """Take the next bytes; yields the packets that they complete.

        Raises:
            RemoteProtocolError: The stream breaks the rules; it cannot be read any further.
        """
        rest = memoryview(data)
        while rest.nbytes or self._body_is_complete():
            if self._body is None and not self._pending:
                size, whole = _whole(rest, self._limits, self._check)
                if whole is not None:
                    yield whole
                    rest = rest[size:]
                    continue
            rest = self._fill_body(rest) if self._body is not None else self._fill_head(rest)
            if self._body_is_complete():
                yield self._take()

    def _body_is_complete(self) -> bool:
        return self._body is not None and self._filled == self._body.nbytes

    def _fill_head(self, data: memoryview) -> memoryview:
        # Take the bytes of this head only: a copy of all the rest for each of many small packets
        # in one chunk would take quadratic time.
        taken = data[: _head_bytes(self._pending, self._limits) - len(self._pending)]
        self._pending += taken
        size = len(self._pending)
        if size == _head_bytes(self._pending, self._limits):
            self._head = _read_head(self._pending, size, self._limits, self._check)
            self._pending.clear()
            self._body, self._filled = _space(sum(self._head[1])), 0
        return data[taken.nbytes :]

    def _fill_body(self, data: memoryview) -> memoryview:
        assert self._body is not None
        take = min(data.nbytes, self._body.nbytes - self._filled)
        self._body[self._filled : self._filled + take] = data[:take]
        self._filled += take
        return data[take:]

    def _take(self) -> Packet:
        assert self._head is not None
        assert self._body is not None
        request_id, lengths = self._head
        frames = _cut(self._body, lengths)
        self._head = self._body = None
        return Packet(request_id, frames)

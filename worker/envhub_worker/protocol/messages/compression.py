"""Lossless compression of a message's large frames, where both sides have agreed on it.

A ``CompressionHeader`` goes in front of the frames and holds each frame's original size.
Compression pays on a network for frames that shrink, such as rendered images but not noise; a
sample of each frame decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits

SMALLEST = 16 * 1024
"""Smaller frames are not worth a call: they fit a few packets of a network."""
_SAMPLE = 16 * 1024
_WORTH = 0.8


def available() -> tuple[str, ...]:
    """The compressions that this process supports, best first."""
    return () if _lz4() is None else ("lz4",)


def pack_frames(frames: Sequence[Buffer], compression: str) -> list[Buffer]:
    """Returns the frames to send; unchanged if compression gains nothing."""
    if all(_size(frame) < SMALLEST for frame in frames):
        return list(frames)
    block = _lz4() if compression == "lz4" else None
    if block is None:
        return list(frames)
    packed = [_packed(frame, block) for frame in frames]
    if all(new is None for new in packed):
        return list(frames)
    sizes = [-1 if n is None else _size(f) for n, f in zip(packed, frames, strict=True)]
    bodies = [f if n is None else n for n, f in zip(packed, frames, strict=True)]
    return [*m.pack_header(m.CompressionHeader(compression, tuple(sizes)), 0), *bodies]


def _packed(frame: Buffer, block: Any) -> bytes | None:
    """The compressed frame, or None if compression saves too little."""
    if _size(frame) < SMALLEST:
        return None
    view = memoryview(frame).cast("B")
    middle = max(0, len(view) // 2 - _SAMPLE // 2)
    # Copied first: a frame in shared memory may change while it is read.
    sample = bytes(view[middle : middle + _SAMPLE])
    if len(block.compress(sample, store_size=False)) > _WORTH * len(sample):
        return None
    compressed: bytes = block.compress(bytes(view), store_size=False)
    return compressed if len(compressed) <= _WORTH * len(view) else None


def unpack_frames(frames: Sequence[Buffer], limits: WireLimits) -> list[Buffer]:
    """The frames as they were before ``pack_frames``.

    Trust: input from the other side. Every size is checked before it is allocated.
    Raises ``MessageTooLargeError``: over ``limits`` once unpacked; ``RemoteProtocolError``: the
    frames do not match their ``CompressionHeader``.
    """
    if not frames or m.number_of(frames[0]) != 0:
        return list(frames)
    header = m.unpack([m.without_id(frames[0])], limits=limits)
    if not isinstance(header, m.CompressionHeader):
        raise RemoteProtocolError("the id 0 is not followed by a CompressionHeader")
    bodies = list(frames[1:])
    _check(header, bodies, limits)
    block = _lz4() if header.compression == "lz4" else None
    if block is None:
        name = header.compression[:20]
        raise RemoteProtocolError(f"there is no agreement on the compression {name!r}")
    return [
        body if size == -1 else _unpacked(body, size, block)
        for body, size in zip(bodies, header.sizes, strict=True)
    ]


def _check(header: m.CompressionHeader, bodies: Sequence[Buffer], limits: WireLimits) -> None:
    if len(header.sizes) != len(bodies):
        raise RemoteProtocolError("CompressionHeader does not fit its frames")
    if any(type(size) is not int or size < -1 for size in header.sizes):
        raise RemoteProtocolError("CompressionHeader has an invalid size")
    total = sum(_size(b) if s == -1 else s for b, s in zip(bodies, header.sizes, strict=True))
    if max(header.sizes, default=0) > limits.frame_bytes or total > limits.message_bytes:
        raise MessageTooLargeError(f"{total} bytes when unpacked are over the limit.")


def _unpacked(body: Buffer, size: int, block: Any) -> bytes:
    try:
        content: bytes = block.decompress(body, uncompressed_size=size)
    except Exception as error:  # lz4 has errors of its own
        raise RemoteProtocolError(f"a frame cannot be unpacked: {error}") from None
    if len(content) != size:
        raise RemoteProtocolError("an unpacked frame has another size than CompressionHeader says")
    return content


def _size(frame: Buffer) -> int:
    return len(frame) if type(frame) is bytes else memoryview(frame).nbytes


def _lz4() -> Any:
    try:
        import lz4.block  # type: ignore[import-not-found,import-untyped,unused-ignore]
    except ImportError:
        return None
    return lz4.block

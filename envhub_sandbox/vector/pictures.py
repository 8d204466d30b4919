"""Encodes frames as small PNG pictures from their numbers; no bytes of a worker are passed on."""

from __future__ import annotations

import struct
import zlib
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Frame: TypeAlias = "NDArray[np.uint8]"
"""uint8 ``(height, width, 3)``."""


def is_frame(value: Any) -> bool:
    """Whether a value is a frame that is not empty."""
    right = isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3
    return right and value.shape[2] == 3 and value.size > 0


def small_picture(frame: Frame, side: int) -> Frame:
    """Shrink a frame to at most ``side`` pixels a side, by the mean of each block of pixels."""
    block = -(-max(frame.shape[:2]) // side)
    if block <= 1:
        return frame
    # if a side is shorter than a block, as in a frame of one line, the block is that short
    down, across = (min(block, length) for length in frame.shape[:2])
    height, width = frame.shape[0] // down, frame.shape[1] // across
    blocks = frame[: height * down, : width * across].reshape(height, down, width, across, 3)
    small: Frame = blocks.mean((1, 3), np.float32).round().astype(np.uint8)
    return small


def png(frame: Frame) -> bytes:
    """A frame as PNG, uint8 ``(height, width, 3)``: eight bits, RGB, filter "Up"."""
    height, width, _ = frame.shape
    lines = np.ascontiguousarray(frame).reshape(height, width * 3)
    above = np.vstack([np.zeros((1, width * 3), np.uint8), lines[:-1]])
    filtered = np.hstack([np.full((height, 1), 2, np.uint8), lines - above])  # modulo 256
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(filtered.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(name, data) for name, data in chunks)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

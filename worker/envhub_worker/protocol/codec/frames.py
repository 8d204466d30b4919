"""The frames of a message: how large they may be, and where the document and its tail lie."""

from __future__ import annotations

from collections.abc import Sequence

from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES, Buffer
from envhub_worker.protocol.errors import (
    LocalProtocolError,
    MessageTooLargeError,
    RemoteProtocolError,
)
from envhub_worker.protocol.limits import WireLimits


def check_outgoing_frames(frames: Sequence[Buffer], limits: WireLimits) -> None:
    """Raises ``LocalProtocolError`` for frames that the receiver will not accept."""
    try:
        _check_sizes(frames, limits)
    except MessageTooLargeError as error:
        raise LocalProtocolError(f"The message is too large to be sent: {error}") from None


def split_frames(
    frames: Sequence[Buffer], limits: WireLimits
) -> tuple[bytes, Buffer, list[Buffer]]:
    """Checks the frames' sizes; returns document, tail of the header, and the other frames.

    Raises:
        MessageTooLargeError: Over one of ``limits``.
        RemoteProtocolError: There is no header, or not all of it.
    """
    flat = [frame if type(frame) is bytes else memoryview(frame).cast("B") for frame in frames]
    _check_sizes(flat, limits)
    header, *buffers = flat
    if len(header) < DOCUMENT_BYTES.size:
        raise RemoteProtocolError("The header is too short.")
    end = DOCUMENT_BYTES.size + DOCUMENT_BYTES.unpack_from(header)[0]
    if end > len(header):
        raise RemoteProtocolError("The header is shorter than it says.")
    return bytes(header[DOCUMENT_BYTES.size : end]), header[end:], buffers


def _check_sizes(frames: Sequence[Buffer], limits: WireLimits) -> None:
    """Raises ``MessageTooLargeError`` for too much. Frames must consist of single bytes."""
    if not frames:
        raise RemoteProtocolError("A message has no frame.")
    if len(frames) == 1 and len(frames[0]) <= min(limits.header_bytes, limits.message_bytes):
        return
    sizes = list(map(len, frames))
    for name, size, cap in (
        ("frames", len(sizes), limits.frames),
        ("header_bytes", sizes[0], limits.header_bytes),
        ("message_bytes", sum(sizes), limits.message_bytes),
        ("frame_bytes", max(sizes), max(limits.frame_bytes, sizes[0])),
    ):
        if size > cap:
            raise MessageTooLargeError(f"{size} is over the limit of {cap} ({name}).")

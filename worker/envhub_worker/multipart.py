"""Whole messages through the server's socket, without what pyzmq's own functions do per frame."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from envhub_worker.protocol.codec.kinds import Buffer

# plain numbers: as members of an enumeration they cost more than the calls that take them
_MORE = int(zmq.SNDMORE)
_NOW = int(zmq.NOBLOCK)
_EVENTS = int(zmq.EVENTS)
_READABLE = int(zmq.POLLIN)


def has_message(socket: zmq.Socket[bytes]) -> bool:
    """Whether ``receive`` would return one: without the exception that ends a vain attempt."""
    return bool(int(socket.getsockopt(_EVENTS)) & _READABLE)


def receive(socket: zmq.Socket[bytes]) -> list[bytes]:
    """The frames of a message that is there; raises ``zmq.Again`` if none is."""
    frame = socket.recv(_NOW, copy=False)
    frames = [frame.bytes]
    while frame.more:
        frame = socket.recv(_NOW, copy=False)
        frames.append(frame.bytes)
    return frames


def send(socket: zmq.Socket[bytes], frames: Sequence[Buffer], *, copy: bool) -> None:
    """Send without waiting; what a client's queue has no room for is dropped.

    Without ``copy``, nobody may write large frames any more.
    """
    for frame in frames[:-1]:
        socket.send(frame, _NOW | _MORE, copy)
    socket.send(frames[-1], _NOW, copy)

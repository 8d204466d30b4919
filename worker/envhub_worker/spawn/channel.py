"""Small JSON messages with file descriptors between the server, its zygote and its inits.

Only our own code holds an end of such a channel: it is closed before a stranger's code runs.
"""

from __future__ import annotations

import array
import collections
import contextlib
import json
import os
import socket
from collections.abc import Sequence
from typing import Any

# SEQPACKET refuses a message above the socket buffer (212992 by default); say so early.
MAX_MESSAGE_BYTES = 128 * 1024
MAX_FDS = 64
_ANCILLARY_BYTES = socket.CMSG_SPACE(MAX_FDS * array.array("i").itemsize)

Message = dict[str, Any]


class Channel:
    """One end of a ``SOCK_SEQPACKET`` pair. Owns the socket."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        # The waiting messages, with duplicates of their descriptors: the caller closes its own at
        # once.
        self._unsent: collections.deque[tuple[bytes, tuple[int, ...]]] = collections.deque()

    @classmethod
    def pair(cls) -> tuple[Channel, socket.socket]:
        """A non-blocking channel, and the blocking socket for the other side."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        return cls(ours), theirs

    def fileno(self) -> int:
        """The socket's descriptor, or -1 when closed."""
        return self._socket.fileno()

    def send(self, message: Message, fds: Sequence[int] = ()) -> None:
        """Send, or keep the message for ``flush`` if the socket is full. ``fds`` stay the caller's.
        Raises ``ValueError``: the message is larger than ``MAX_MESSAGE_BYTES``.
        """
        data = json.dumps(message).encode()
        if len(data) > MAX_MESSAGE_BYTES:
            raise ValueError(f"message of {len(data)} bytes is over {MAX_MESSAGE_BYTES}")
        self._unsent.append((data, tuple(os.dup(fd) for fd in fds)))
        self.flush()

    def send_pidfd(self, message: Message, pid: int) -> None:
        """Send with a pidfd of ``pid``, a child that is not reaped yet, or this process."""
        pidfd = os.pidfd_open(pid)
        try:
            self.send(message, [pidfd])
        finally:
            os.close(pidfd)

    def flush(self) -> None:
        """Send waiting messages as far as the socket takes them. A peer that has ended is no error.
        Raises ``OSError``: a message cannot be sent, and is dropped.
        """
        while self._unsent:
            data, fds = self._unsent[0]
            try:
                socket.send_fds(self._socket, [data], fds, socket.MSG_NOSIGNAL)
            except BlockingIOError:
                return
            except ConnectionError:
                pass  # the reader sees the end of the stream and says what died
            except OSError:
                self._drop_first()
                raise
            self._drop_first()

    def _drop_first(self) -> None:
        close_fds(self._unsent.popleft()[1])

    def receive(self) -> tuple[Message, list[int]] | None:
        """Returns the next message and its descriptors, or None at the end of the stream.
        Raises ``BlockingIOError``: no message has arrived (non-blocking sockets).
        """
        try:
            data, fds, flags = self._receive()
        except ConnectionResetError:
            # Raised once if the peer closed without reading our messages; its own still arrive.
            data, fds, flags = self._receive()
        if not data:
            return None
        if flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
            raise AssertionError("a message was cut off")  # also where PYTHONOPTIMIZE is granted
        return json.loads(data), fds

    def _receive(self) -> tuple[bytes, list[int], int]:
        # Not socket.recv_fds: before Python 3.13 it drops the flags, and so CLOEXEC.
        data, ancillary, flags, _ = self._socket.recvmsg(
            MAX_MESSAGE_BYTES, _ANCILLARY_BYTES, socket.MSG_CMSG_CLOEXEC
        )
        fds = array.array("i")
        for level, kind, content in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                fds.frombytes(content[: len(content) - len(content) % fds.itemsize])
        return data, list(fds), flags

    def drain(self) -> tuple[list[tuple[Message, list[int]]], bool]:
        """Returns all messages that have arrived, and whether the stream has ended."""
        messages: list[tuple[Message, list[int]]] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                received = self.receive()
                if received is None:
                    return messages, True
                messages.append(received)
        return messages, False

    def close(self) -> None:
        """Close the socket and drop unsent messages. Idempotent."""
        while self._unsent:
            self._drop_first()
        self._socket.close()


def close_fds(fds: Sequence[int]) -> None:
    """Close each descriptor."""
    for fd in fds:
        os.close(fd)

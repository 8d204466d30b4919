"""The descriptor socket, over which a client's slabs and doorbells get to a runner.

ZeroMQ carries no descriptors, so they come over a ``SOCK_SEQPACKET`` socket in the server's
private folder and wait here until the server sends them with the runner's ``Attach``. The server
does not decode an ``Attach``: it knows it by the operation of its ``Relay``. A connection carries
one request, and no connection can block the server.
"""

from __future__ import annotations

import socket
from collections.abc import Callable

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.spawn.channel import close_fds

FDS = 5
"""Descriptors of one deposit: three slabs, the doorbell that the runner hears, the one it rings."""
_REQUEST_BYTES = 4096
_WAIT_S = 1.0

PidfdFor = Callable[[m.Deposit], int | None]
"""The pidfd of the jail that a deposit is for; negative before it is known, or None if the client
may not have it."""


class FdStore:
    """Descriptors that wait for their runner, and the socket that receives them."""

    def __init__(self, path: str, pidfd_for: PidfdFor) -> None:
        self._pidfd_for = pidfd_for
        # By jail and runner: sent on with the runner's ``Attach``, or closed with its jail.
        self._waiting: dict[tuple[int, int], list[int]] = {}
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(path)
        self._listener.listen(16)
        self._listener.setblocking(False)

    def fileno(self) -> int:
        """A descriptor that is readable when a client connects."""
        return self._listener.fileno()

    def accept(self) -> None:
        """Serve one client. It is trusted: the folder is private and its session is checked."""
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        with connection:
            connection.settimeout(_WAIT_S)
            try:
                self._serve(connection)
            except (OSError, ProtocolError):
                return  # the client sees the end of the connection

    def _serve(self, connection: socket.socket) -> None:
        data, fds, _, _ = socket.recv_fds(connection, _REQUEST_BYTES, FDS)
        try:
            request = m.unpack([data])
            pidfd = self._pidfd_for(request) if isinstance(request, m.Deposit) else None
            if pidfd is None or len(fds) != FDS:
                return
            if pidfd < 0:
                connection.send(m.NOT_YET)
                return
            assert isinstance(request, m.Deposit)
            self.put(request.jail, request.runner, fds)
            fds = []  # the store owns them now
            # The client steps without the server from now on: the pidfd tells it when the jail has
            # ended, or the runner of a jail that is kept.
            socket.send_fds(connection, [m.TAKEN], [pidfd])
        finally:
            close_fds(fds)

    def put(self, jail: int, runner: int, fds: list[int]) -> None:
        """Take ownership of descriptors for a runner; they replace earlier ones."""
        close_fds(self._waiting.pop((jail, runner), []))
        self._waiting[jail, runner] = fds

    def take(self, jail: int, runner: int) -> list[int]:
        """Returns the descriptors for a runner; the caller closes them."""
        return self._waiting.pop((jail, runner), [])

    def drop(self, jail: int) -> None:
        """Close the descriptors of a jail that has ended."""
        for key in [key for key in self._waiting if key[0] == jail]:
            close_fds(self._waiting.pop(key))

    def close(self) -> None:
        """Close everything."""
        self._listener.close()
        for fds in self._waiting.values():
            close_fds(fds)
        self._waiting.clear()

"""Knows which connections are open, and lets no more in while there are too many of them.

Strangers make them, too, and each takes a descriptor and memory before any key is asked for.
libzmq cannot pause its listener, and ends a listener's connections with it. So a filter has the
kernel drop what knocks: connections that are open stay, and who knocks again later is let in.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import stat
import struct

import zmq

from envhub_worker.access.audit.log import Log
from envhub_worker.loop import Loop

MAX_CONNECTIONS = 1024
_FAILED = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_EVENTS = _FAILED | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
_EVENT = struct.Struct("=HI")  # a monitor's first frame: what, and a number (zmq_socket_monitor(3))
_SO_ATTACH_FILTER = 26
_SO_DETACH_FILTER = 27
_DROP = struct.pack("=HBBI", 0x06, 0, 0, 0)  # BPF: return 0 bytes of the packet


class ConnectionLimiter:
    """Watches a socket's connections. To be made before it is bound.
    ``limit``: connections at once. The backlog may come in besides.
    """

    def __init__(self, router: zmq.Socket[bytes], loop: Loop, log: Log, limit: int) -> None:
        self._router = router
        self._log = log
        self._limit = limit
        self._open = 0
        self._accepted = 0
        self._wires: dict[int, int] = {}
        self._shut_listener: socket.socket | None = None
        self._monitor = router.get_monitor_socket(_EVENTS)
        loop.watch(self._monitor, self._drain)

    def _drain(self) -> None:
        while True:
            try:
                frames = self._monitor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._happened(*_EVENT.unpack_from(frames[0]))

    def _happened(self, event: int, value: int) -> None:
        if event == zmq.EVENT_ACCEPTED:
            self._open += 1
            self._accepted += 1
            self._wires[value] = self._accepted
            if self._open >= self._limit and self._shut_listener is None:
                self._shut()
        elif event == zmq.EVENT_DISCONNECTED:
            self._open -= 1
            self._wires.pop(value, None)
        else:
            self._log.say("handshake_failed", why="no key, another server's, or noise")

    def wire(self, fd: int) -> int:
        """The number of the connection that a message has come from; 0 if that has ended since.

        A descriptor's number is given out again, this one never, and none has 0.
        """
        self._drain()  # libzmq says that it has accepted before it hands anything on
        return self._wires.get(fd, 0)

    def open_wires(self) -> frozenset[int]:
        """The numbers of all connections that are there now."""
        self._drain()
        return frozenset(self._wires.values())

    def _shut(self) -> None:
        """Without descriptors or permission it stays open, and the next one tries again."""
        listener = None
        try:
            listener = _listener(str(self._router.get_string(zmq.LAST_ENDPOINT)))
            if listener is None:
                return
            program = ctypes.create_string_buffer(_DROP)
            filters = struct.pack("@HP", 1, ctypes.addressof(program))
            listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, filters)
        except OSError as error:
            if listener is not None:
                listener.close()
            self._log.say("connections_full", connections=self._open, why=f"and no end: {error}")
            return
        self._shut_listener = listener
        self._log.say("connections_full", connections=self._open, why="no more for the moment")

    def tick(self) -> None:
        """Let others in once there is room."""
        if self._shut_listener is not None and self._open < self._limit:
            with contextlib.suppress(OSError):  # there is no filter any more
                self._shut_listener.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
            self._shut_listener.close()
            self._shut_listener = None

    def close(self) -> None:
        """Stop watching."""
        if self._shut_listener is not None:
            self._shut_listener.close()
        # in this order: a context does not end while the monitor's other end is open
        self._router.disable_monitor()
        self._monitor.close()


def _listener(endpoint: str) -> socket.socket | None:
    """The listening socket of an endpoint of ours: the kernel names it, libzmq does not."""
    port = int(endpoint.rpartition(":")[2])
    for name in os.listdir("/proc/self/fd"):
        fd = int(name)
        with contextlib.suppress(OSError):  # it is closed by now, or there are too many
            if stat.S_ISSOCK(os.fstat(fd).st_mode) and _listens_on(fd, port):
                return socket.socket(fileno=os.dup(fd))
    return None


def _listens_on(fd: int, port: int) -> bool:
    found = socket.socket(fileno=fd)
    try:
        if found.family not in (socket.AF_INET, socket.AF_INET6):
            return False
        accepts = found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
        return bool(accepts) and found.getsockname()[1] == port
    finally:
        found.detach()  # it is libzmq's

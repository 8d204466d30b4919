"""A port that answers GET, for monitoring: small, slow and bounded.

One thread, one poll, a page made beforehand. Who sends much, sends slowly or comes in crowds gets
little: a request has a size and a time, and a newcomer takes the place of the connection that has
been there the longest. Nothing of it touches the server's own loop.
"""

from __future__ import annotations

import contextlib
import ipaddress
import selectors
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from time import monotonic
from traceback import format_exc

MAX_REQUEST_BYTES = 8192
MAX_CONNECTIONS = 32
PATIENCE_S = 5.0
"""From a connection's beginning to its end."""
_LOOK_S = 0.5
_PAUSE_S = 0.5
_PIECE_BYTES = 4096
_ENDS = (b"\r\n\r\n", b"\n\n")

Reply = tuple[int, str, bytes]
"""Status, content type, body."""


@dataclass(eq=False)
class _Connection:
    sock: socket.socket
    since: float = field(default_factory=monotonic)
    asked: bytearray = field(default_factory=bytearray)
    left: memoryview | None = None


class HttpPort:
    """Listens until it is closed; on any port that is free if that is 0.

    ``answer`` gives the page of a path; what it raises is a 500, and ``failed`` gets the traceback.
    Raises ``OSError``: the address is not to be had.
    """

    def __init__(
        self,
        host: str,
        port: int,
        answer: Callable[[str], Reply],
        failed: Callable[[str], None],
    ) -> None:
        self._answer = answer
        self._failed = failed
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=MAX_CONNECTIONS)
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._connections: dict[_Connection, None] = {}  # the oldest first
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="envhub metrics", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """``HOST:PORT``, with the port that was found."""
        host, port = self._listener.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def close(self) -> None:
        """Stop listening, and drop who is there."""
        self._stopped.set()
        self._thread.join(2 * _LOOK_S)

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                self._round()
        finally:
            for connection in list(self._connections):
                self._drop(connection)
            self._selector.close()
            self._listener.close()

    def _round(self) -> None:
        for key, _ in self._selector.select(_LOOK_S):
            if key.fileobj is self._listener:
                self._accept()
            elif key.data in self._connections:  # else it made room for another just now
                self._serve(key.data)
        late = monotonic() - PATIENCE_S
        for connection in [one for one in self._connections if one.since < late]:
            self._drop(connection)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:  # no descriptor is left: who knocks goes on knocking
            self._stopped.wait(_PAUSE_S)
            return
        if len(self._connections) >= MAX_CONNECTIONS:
            self._drop(next(iter(self._connections)))
        sock.setblocking(False)
        connection = _Connection(sock)
        self._connections[connection] = None
        self._selector.register(sock, selectors.EVENT_READ, connection)

    def _drop(self, connection: _Connection) -> None:
        del self._connections[connection]
        self._selector.unregister(connection.sock)
        connection.sock.close()

    def _serve(self, connection: _Connection) -> None:
        try:
            if connection.left is None:
                self._read(connection)
            if connection.left is not None:
                self._write(connection)
        except BlockingIOError:
            return
        except OSError:  # it has gone
            self._drop(connection)

    def _read(self, connection: _Connection) -> None:
        piece = connection.sock.recv(_PIECE_BYTES)
        connection.asked += piece
        if any(end in connection.asked for end in _ENDS):
            connection.left = memoryview(self._reply(bytes(connection.asked)))
        elif len(connection.asked) > MAX_REQUEST_BYTES:
            connection.left = memoryview(_bytes(431, "text/plain", b""))
        elif not piece:
            raise ConnectionError
        else:
            return
        self._selector.modify(connection.sock, selectors.EVENT_WRITE, connection)

    def _write(self, connection: _Connection) -> None:
        assert connection.left is not None
        sent = connection.sock.send(connection.left)
        connection.left = connection.left[sent:]
        if not connection.left:
            with contextlib.suppress(OSError):
                connection.sock.shutdown(socket.SHUT_WR)
            self._drop(connection)

    def _reply(self, asked: bytes) -> bytes:
        line = asked.split(b"\n", 1)[0].decode("latin-1").split()
        if len(line) != 3 or not line[2].startswith("HTTP/1."):
            return _bytes(400, "text/plain", b"")
        method, target, _ = line
        if method not in ("GET", "HEAD"):
            return _bytes(405, "text/plain", b"")
        try:
            status, kind, body = self._answer(target.partition("?")[0])
        except Exception:
            self._failed(format_exc())
            return _bytes(500, "text/plain", b"")
        return _bytes(status, kind, body, head=method == "HEAD")


def _bytes(status: int, kind: str, body: bytes, *, head: bool = False) -> bytes:
    head_lines = (
        f"HTTP/1.1 {status} {HTTPStatus(status).phrase}",
        f"Content-Type: {kind}",
        f"Content-Length: {len(body)}",
        "Cache-Control: no-store",
        "Connection: close",
        "",
        "",
    )
    return "\r\n".join(head_lines).encode("latin-1") + (b"" if head else body)


def parse_address(text: str) -> tuple[str, int]:
    """``PORT``, ``HOST:PORT`` or ``[HOST]:PORT``; without a host it is 127.0.0.1.
    Raises ``ValueError``: it is none; the text says what it takes.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    try:
        ipaddress.ip_address(host)
        number = int(port)
        if not 0 <= number <= 65_535 or not port.isascii() or not port.isdigit():
            raise ValueError
    except ValueError:
        raise ValueError(
            f"--metrics takes PORT or ADDRESS:PORT, such as 127.0.0.1:9090, not {text!r}"
        ) from None
    return host, number

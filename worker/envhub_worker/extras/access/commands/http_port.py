"""A port that answers GET, for monitoring: small, slow and bounded.

It resists floods and slow clients: size and time of a request are limited, and a new connection
replaces the oldest one if there are too many. It never blocks the server's own loop.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from socketserver import BaseRequestHandler, ThreadingTCPServer
from traceback import format_exc
from typing import Any

MAX_REQUEST_BYTES = 8192
MAX_CONNECTIONS = 32
PATIENCE_S = 5.0
"""Most seconds that a connection may last."""
_PAUSE_S = 0.5
_PIECE_BYTES = 4096
_ENDS = (b"\r\n\r\n", b"\n\n")

Reply = tuple[int, str, bytes]
"""Status, content type, body."""


class HttpPort(ThreadingTCPServer):
    """Listens until it is closed; port 0 means any free port.

    ``answer`` returns the page of a path; its error is answered by 500, and ``failed`` gets the
    traceback. Raises ``OSError``: the address is not available.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = MAX_CONNECTIONS

    def __init__(
        self, host: str, port: int, answer: Callable[[str], Reply], failed: Callable[[str], None]
    ) -> None:
        self._answer = answer
        self._failed = failed
        self._lock = threading.Lock()
        self._answering = threading.Lock()
        self._connections: dict[socket.socket, None] = {}  # the oldest first
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler)
        self._thread = threading.Thread(
            target=self.serve_forever, name="envhub metrics", daemon=True
        )
        self._thread.start()

    @property
    def address(self) -> str:
        """``HOST:PORT``, with the port that was found."""
        host, port = self.socket.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def close(self) -> None:
        """Stop listening, and drop all connections."""
        self.shutdown()
        self.server_close()
        with self._lock:
            while self._connections:
                self._cut_oldest()

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection. Without a free descriptor it stays in the backlog: wait a moment."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread; the oldest is dropped if there are too many."""
        with self._lock:
            if len(self._connections) >= MAX_CONNECTIONS:
                self._cut_oldest()
            self._connections[request] = None
        super().process_request(request, client_address)

    def _cut_oldest(self) -> None:
        oldest = next(iter(self._connections))
        del self._connections[oldest]
        with contextlib.suppress(OSError):
            oldest.shutdown(socket.SHUT_RDWR)  # its thread then closes it

    def shutdown_request(self, request: Any) -> None:
        """Close a connection that was served."""
        with self._lock:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of a connection: its peer is too slow or has closed it."""

    def reply(self, asked: bytes) -> bytes:
        """The answer to a whole request."""
        line = asked.split(b"\n", 1)[0].decode("latin-1").split()
        if len(line) != 3 or not line[2].startswith("HTTP/1."):
            return _bytes(400, "text/plain", b"")
        method, target, _ = line
        if method not in ("GET", "HEAD"):
            return _bytes(405, "text/plain", b"")
        try:
            with self._answering:  # a page is made once, however many ask
                status, kind, body = self._answer(target.partition("?")[0])
        except Exception:
            self._failed(format_exc())
            return _bytes(500, "text/plain", b"")
        return _bytes(status, kind, body, head=method == "HEAD")


class _Handler(BaseRequestHandler):
    server: HttpPort

    def handle(self) -> None:
        until, asked = time.monotonic() + PATIENCE_S, b""
        while not any(end in asked for end in _ENDS):
            if len(asked) > MAX_REQUEST_BYTES:
                self.request.sendall(_bytes(431, "text/plain", b""))
                return
            self.request.settimeout(max(until - time.monotonic(), 0.001))
            piece = self.request.recv(_PIECE_BYTES)
            if not piece:
                return
            asked += piece
        reply = self.server.reply(asked)
        self.request.settimeout(max(until - time.monotonic(), 0.001))
        self.request.sendall(reply)


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
    """Parses ``PORT``, ``HOST:PORT`` or ``[HOST]:PORT``; the default host is 127.0.0.1.
    Raises ``ValueError``: the text is no address; the error lists the forms.
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

"""Ports of loopback: those for programs that bind them themselves, and small HTTP servers."""

import contextlib
import random
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

_given: list[socket.socket] = []
"""A name for each port that was given away: no other test gets it while this process lives."""


def lasting_port() -> int:
    """A port below those that the kernel gives to anybody: it is still free a while later."""
    while True:
        number = random.randrange(20_000, 32_000)
        name = socket.socket(socket.AF_UNIX)
        try:
            name.bind(f"\0envhub-test-port-{number}")
            with socket.socket() as sock:
                sock.bind(("127.0.0.1", number))
        except OSError:
            name.close()
            continue
        _given.append(name)
        return number


class QuietHandler(BaseHTTPRequestHandler):
    """Logs nothing."""

    def log_message(self, format: str, *args: object) -> None:
        """Called with each request."""


@contextlib.contextmanager
def serving(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """An HTTP server, in a thread; its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()

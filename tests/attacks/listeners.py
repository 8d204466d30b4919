"""Sockets of the test's own, outside of every jail, that note what reaches them."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.support.processes import eventually

_POLL_S = 0.05
_GRACE_S = 0.3


class Listener:
    """Receives in the background; ``heard`` says whether some text came."""

    def __init__(self, sock: socket.socket, *, accepts: bool) -> None:
        self.socket = sock
        self._accepts = accepts
        self._data = b""
        self._stopped = False
        self._thread = threading.Thread(target=self._receive, daemon=True)
        sock.setblocking(False)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that it is bound to."""
        return int(self.socket.getsockname()[1])

    def heard(self, text: str, *, wait: bool) -> bool:
        """Whether ``text`` has come, waiting generously if it is expected to."""
        deadline = 10.0 if wait else _GRACE_S
        return eventually(lambda: text.encode() in self._data, deadline)

    def forget(self) -> None:
        """Drop what has come."""
        self._data = b""

    def _receive(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self.socket, selectors.EVENT_READ)
            while not self._stopped:
                for key, _ in selector.select(_POLL_S):
                    with contextlib.suppress(OSError):
                        self._take(selector, key.fileobj)

    def _take(self, selector: selectors.BaseSelector, source: Any) -> None:
        if self._accepts and source is self.socket:
            connection, _ = source.accept()
            connection.setblocking(False)
            selector.register(connection, selectors.EVENT_READ)
            self._data += b"<connection>"
            return
        data = source.recv(65536)
        self._data += data
        if not data and source is not self.socket:
            selector.unregister(source)
            source.close()

    def close(self) -> None:
        """Stop receiving."""
        self._stopped = True
        self._thread.join()
        self.socket.close()


@contextmanager
def listening(
    family: int, kind: int, address: Any, *options: tuple[int, int, int], protocol: int = 0
) -> Iterator[Listener]:
    """A listener bound to ``address``; ``options`` are for ``setsockopt``."""
    sock = socket.socket(family, kind, protocol)
    for option in options:
        sock.setsockopt(*option)
    sock.bind(address)
    if kind == socket.SOCK_STREAM:
        sock.listen(16)
    listener = Listener(sock, accepts=kind == socket.SOCK_STREAM)
    try:
        yield listener
    finally:
        listener.close()

"""A wire between client and server that can be slow, be cut, and be listened in on."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Relay:
    """Forwards TCP connections to a port of this machine, and keeps what clients sent.

    Args:
        port: Where to.
        delay_s: How long every piece takes, each way.

    Attributes:
        captured: What clients sent, one for each connection.
        received: How many bytes the server sent.
    """

    def __init__(self, port: int, delay_s: float = 0.0) -> None:
        self.delay_s = delay_s
        self.captured: list[bytearray] = []
        self.received = 0
        self._to = port
        self._sockets: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._pumps: list[threading.Thread] = []
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()

    @property
    def endpoint(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._to))
                self._sockets += [client, server]
                kept = bytearray()
                self.captured.append(kept)
                for ends in ((client, server, kept), (server, client, None)):
                    self._pumps.append(threading.Thread(target=self._pump, args=ends))
                    self._pumps[-1].start()

    def _pump(self, source: socket.socket, target: socket.socket, kept: bytearray | None) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                if kept is None:
                    self.received += len(data)
                else:
                    kept += data
                time.sleep(self.delay_s)
                target.sendall(data)
        for one in (source, target):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._accepting.join()
        self._listener.close()
        self.cut()
        for pump in self._pumps:  # a number that is closed under one may be another socket's
            pump.join()
        for one in self._sockets:
            one.close()


@contextmanager
def relay(port: int, delay_s: float = 0.0) -> Iterator[Relay]:
    made = Relay(port, delay_s)
    try:
        yield made
    finally:
        made.close()

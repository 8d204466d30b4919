"""Sockets of the test's own, outside of every jail, that note what reaches them."""

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import psutil

from tests.attacks.harness import Attacks, Run, token
from tests.support.processes import eventually

_POLL_S = 0.05
_GRACE_S = 0.3
_PATIENCE_S = 60.0


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
        return int(self.socket.getsockname()[1])

    @property
    def where(self) -> dict[str, Any]:
        name = self.socket.getsockname()
        if self.socket.family == socket.AF_UNIX:
            return {"path": f"@{name[1:].decode()}" if isinstance(name, bytes) else name}
        if self.socket.family == socket.AF_PACKET:
            return {"device": name[0]}
        if self.socket.family == socket.AF_NETLINK:
            return {"port": name[0]}
        raw = self.socket.type == socket.SOCK_RAW
        return {"host": name[0]} if raw else {"host": name[0], "port": name[1]}

    def heard(self, text: str, *, wait: bool) -> bool:
        """Whether ``text`` has come, waiting generously if it is expected to."""
        return eventually(lambda: text.encode() in self._data, _PATIENCE_S if wait else _GRACE_S)

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
        self._stopped = True
        self._thread.join()
        self.socket.close()


TCP = {"family": socket.AF_INET, "kind": socket.SOCK_STREAM, "address": ("127.0.0.1", 0)}
UDP = {**TCP, "kind": socket.SOCK_DGRAM}
TCP6, UDP6 = ({**one, "family": socket.AF_INET6, "address": ("::1", 0)} for one in (TCP, UDP))
NETLINK = {"family": socket.AF_NETLINK, "kind": socket.SOCK_RAW, "address": (0, 0), "protocol": 2}
ICMP = {**TCP, "kind": socket.SOCK_RAW, "protocol": socket.IPPROTO_ICMP}
_FRAME = 0x88B5
FRAMES = {
    "family": socket.AF_PACKET,
    "kind": socket.SOCK_RAW,
    "address": ("lo", _FRAME),
    "protocol": socket.htons(_FRAME),
}
"""Arguments of ``listening``; only root can listen to the last two."""


@contextmanager
def listening(
    family: int,
    kind: int,
    address: Any,
    options: Sequence[tuple[int, int, int]] = (),
    protocol: int = 0,
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


def sends(place: Attacks, title: str, payload: str, listener: Listener, **arguments: Any) -> None:
    """Attack with a message that ``listener`` must hear in the control, and never from inside.
    Each half has a message of its own: what the control sends a second time may still be on its
    way when the inside begins."""
    control, inside = token(), token()

    def heard(run: Run) -> bool:
        return listener.heard(inside if run.inside else control, wait=not run.inside)

    halves = {"message": control, "inside": {"message": inside}}
    place.attack(title, payload, heard, **halves, **(listener.where | arguments))


def network_addresses() -> list[str]:
    """The hardware addresses of this host's network devices, without their colons."""
    return [
        address.address.replace(":", "")
        for addresses in psutil.net_if_addrs().values()
        for address in addresses
        if address.family == psutil.AF_LINK and address.address.strip("0:")
    ]

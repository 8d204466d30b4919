"""Memory that is shared with a jail and that the jail cannot take away.

Followed: ``memfd_create(2)``, ``fcntl(2)`` on sealing.

The doorbells of the fast lane: no call here waits for what the jail does with its copies.

All holders of an open file description share its flags and its counter. A jail that holds our
eventfd can fill it and clear ``O_NONBLOCK``: then our next ``write`` to it never returns. It can
also empty the eventfd between our ``poll`` and our ``read``. So we neither write to it nor read it.

*We ring* through a socket pair, each end of which is a description of its own. ``MSG_DONTWAIT`` is
a flag of our call, which the jail cannot clear; a full socket has been rung already.
``MSG_NOSIGNAL``, because the jail may close its end. Our end receives nothing (``SHUT_RD``): a
``send`` to it fails at the sender. Otherwise the jail could queue descriptors there, and we would
have to close them, which takes as long as their file systems and sockets please. A pipe would not
do: its two ends share a lock, which a reader holds while its page faults are served, and a write to
a broken pipe raises SIGPIPE.

*The jail rings* through an eventfd that we only watch, edge-triggered: each write wakes us once,
and we never read it. The jail may fill, empty or close it, or write to it without end: then we do
not hear the jail, or wake up as often as it makes system calls itself.

Followed: ``eventfd(2)``, ``epoll(7)``, ``unix(7)``, ``send(2)``.
"""

from __future__ import annotations

import fcntl
import io
import mmap
import os
import select
import socket

SEAL_FUTURE_WRITE = 0x10
"""``F_SEAL_FUTURE_WRITE``: no other process maps it writable."""
_ADD_SEALS = 1033
_SIZE_SEALS = 0x1 | 0x2 | 0x4
"""``F_SEAL_SEAL``, ``F_SEAL_SHRINK`` and ``F_SEAL_GROW``, by number: systems without them import
this file too."""


def sealed_memfd(name: str, size: int, further_seals: int = 0) -> tuple[mmap.mmap, io.FileIO]:
    """A sealed memfd of a fixed size, mapped here, and its file.

    Without the seals a jail could truncate the memory, and our next access would be a SIGBUS.
    The descriptor is a file object, not a number: interruption.md, rule 5.
    """
    file = io.FileIO(os.memfd_create(f"envhub-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING), "r+")
    file.truncate(size)
    mapped = mmap.mmap(file.fileno(), size)
    # Last: the file has its size by now, and ``SEAL_FUTURE_WRITE`` spares the map that exists.
    fcntl.fcntl(file, _ADD_SEALS, _SIZE_SEALS | further_seals)
    return mapped, file


_RING = (1).to_bytes(8, "little")  # as an eventfd takes it
_EVENTS = 8
"""Events of one wait: what else has happened is still there for the next."""
_AT_ONCE = socket.MSG_DONTWAIT | getattr(socket, "MSG_NOSIGNAL", 0)


class RunnerBell:
    """The doorbell that we ring and a runner hears.

    Attributes:
        theirs: The runner's end.
    """

    def __init__(self) -> None:
        self._ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ours.shutdown(socket.SHUT_RD)
        self._send = self._ours.send  # looked up once: a ring is on the hot path
        self.theirs = self._theirs.fileno()

    def handed_over(self) -> None:
        """Close our copy of the runner's end once the runner has its own. Idempotent."""
        self._theirs.close()

    def ring(self) -> None:
        """Ring; never waits."""
        try:
            self._send(_RING, _AT_ONCE)
        except OSError:
            return  # full: it has been rung already; closed: the wait for the answer sees why

    def close(self) -> None:
        """Close both ends. Idempotent."""
        self._ours.close()
        self._theirs.close()


class OwnBell:
    """The doorbell that a runner rings and we hear. We only watch it: no read and no write."""

    def __init__(self) -> None:
        # A file object closes its descriptor with its last reference, whatever interrupts the code
        # that holds it.
        self._file = io.FileIO(os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK), "r+")

    def fileno(self) -> int:
        """Its descriptor, for the runner and for ``Watch``."""
        return self._file.fileno()

    def close(self) -> None:
        """Close our copy."""
        self._file.close()


class Watch:
    """Waits for doorbells, and for deaths."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._deaths: set[int] = set()  # pidfds, among all that is watched

    def bell(self, bell: OwnBell) -> None:
        """Watch a doorbell: each ring wakes ``wait``, and so does an earlier ring."""
        self._epoll.register(bell, select.EPOLLIN | select.EPOLLET)

    def death(self, fd: int) -> None:
        """Watch a pidfd, which is readable from the end of its process on."""
        self._epoll.register(fd, select.EPOLLIN)
        self._deaths.add(fd)

    def forget(self, source: OwnBell | int) -> None:
        """Stop watching. Call it before the close: the jail's copy would ring on."""
        self._epoll.unregister(source)
        if isinstance(source, int):
            self._deaths.discard(source)

    def wait(self, timeout_ms: int | None) -> bool:
        """Wait for a ring or a death, without a limit for None; returns whether it was a death."""
        deaths, timeout_s = self._deaths, -1 if timeout_ms is None else timeout_ms / 1000
        for fd, _ in self._epoll.poll(timeout_s, _EVENTS):  # noqa: SIM110 - the hot path
            if fd in deaths:
                return True
        return False

    def fileno(self) -> int:
        """A descriptor that is readable when ``wait`` would return, for use in another poll."""
        return self._epoll.fileno()

    def close(self) -> None:
        """Stop watching."""
        self._epoll.close()

"""Memory that is shared with a jail and that the jail cannot take away.

Followed: ``memfd_create(2)``, ``fcntl(2)`` on sealing.

The doorbells of the fast lane: nothing here can wait on what the jail does with its copies.

The flags and the counter of an open file description belong to everybody who holds it. A jail that
holds our eventfd can fill it and clear ``O_NONBLOCK``: then our next ``write`` to it never returns;
it can empty it between our ``poll`` and our ``read``. So we do neither.

*We ring* through a socket pair, each end of which is a description of its own. ``MSG_DONTWAIT`` is
our word alone, and a full socket has been rung already; ``MSG_NOSIGNAL``, because the jail may
close its end. Our end receives nothing (``SHUT_RD``): what is sent to it fails at the sender's.
Descriptors would otherwise wait in our queue and be closed by us, which takes as long as their
file systems and sockets please. A pipe would not do: its two ends share a lock, which a reader
holds while its page faults are served, and a broken one raises SIGPIPE.

*The jail rings* through an eventfd that we only watch, edge by edge: each of its writes wakes us
once, and there is nothing to take back. It may fill it, empty it, close it or write to it without
end: then it is not heard, or costs us as many wake-ups as it makes system calls itself.

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

    Without the seals a jail could cut the memory, and the next look at it would be a SIGBUS. It is
    a file and no number: interruption.md, rule 5.
    """
    file = io.FileIO(os.memfd_create(f"envhub-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING), "r+")
    file.truncate(size)
    mapped = mmap.mmap(file.fileno(), size)
    fcntl.fcntl(file, _ADD_SEALS, _SIZE_SEALS | further_seals)
    return mapped, file


_RING = (1).to_bytes(8, "little")  # as an eventfd takes it
_EVENTS = 8
"""Events of one wait: what else has happened is still there for the next."""
_AT_ONCE = socket.MSG_DONTWAIT | getattr(socket, "MSG_NOSIGNAL", 0)


class RunnerBell:
    """The doorbell that we ring, and a runner hears.

    Attributes:
        theirs: The runner's end.
    """

    def __init__(self) -> None:
        self._ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ours.shutdown(socket.SHUT_RD)
        self._send = self._ours.send
        self.theirs = self._theirs.fileno()

    def handed_over(self) -> None:
        """The runner has its copy. Idempotent."""
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
    """The doorbell that a runner rings and we hear. It is watched, and neither read nor written."""

    def __init__(self) -> None:
        # as a file it is closed with its last owner, whatever interrupts that one
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
        self._deaths: set[int] = set()

    def bell(self, bell: OwnBell) -> None:
        """Wake up at its rings; one that came before counts, too."""
        self._epoll.register(bell, select.EPOLLIN | select.EPOLLET)

    def death(self, fd: int) -> None:
        """Wake up for as long as this is readable: a process has ended."""
        self._epoll.register(fd, select.EPOLLIN)
        self._deaths.add(fd)

    def forget(self, source: OwnBell | int) -> None:
        """Before it is closed: the jail has a copy, and would go on ringing it."""
        self._epoll.unregister(source)
        if isinstance(source, int):
            self._deaths.discard(source)

    def wait(self, timeout_ms: int | None) -> bool:
        """Wait for a ring or a death, or None for ever; whether it was a death."""
        deaths, timeout_s = self._deaths, -1 if timeout_ms is None else timeout_ms / 1000
        for fd, _ in self._epoll.poll(timeout_s, _EVENTS):  # noqa: SIM110 - the hot path
            if fd in deaths:
                return True
        return False

    def fileno(self) -> int:
        """Readable when there is something to wait for: it can be polled among others."""
        return self._epoll.fileno()

    def close(self) -> None:
        """Stop watching."""
        self._epoll.close()

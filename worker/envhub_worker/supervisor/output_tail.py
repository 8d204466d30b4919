"""What a jail prints: read as it comes, the last bytes kept, shown with controls escaped."""

from __future__ import annotations

import os

from envhub_worker.protocol.text import printable

_CHUNK = 1 << 16
MAX_BYTES = 1 << 20
"""What one reply tells at most."""


class OutputTail:
    """The last ``limit`` bytes of a pipe that a jail writes to. Owns the descriptor.
    ``ended``: nothing more will come.
    """

    def __init__(self, fd: int, limit: int) -> None:
        self.ended = False
        self._fd = fd
        self._limit = limit
        self._kept = bytearray()
        self._total = 0

    def fileno(self) -> int:
        """The descriptor, or -1 once it is closed."""
        return self._fd

    def read(self) -> None:
        """Take what is there. One read a call, so that a flood cannot hold up the server."""
        if self._fd < 0 or self.ended:
            return
        try:
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return
        self.ended = not data  # its watcher closes it: its number is soon another's
        self._kept += data
        self._total += len(data)
        if len(self._kept) > 2 * self._limit:
            del self._kept[: -self._limit]

    def since(self, offset: int) -> tuple[int, bytes]:
        """What came from this byte on, and where that begins: later, if it is not kept any more."""
        first = self._total - len(self._kept)
        start = min(max(offset, first), self._total)
        return start, bytes(self._kept[start - first : start - first + MAX_BYTES])

    def text(self, lines: int = 40) -> str:
        """The last lines, fit for a terminal."""
        kept = bytes(self._kept[-self._limit :]).decode("utf-8", "backslashreplace")
        return printable("\n".join(kept.splitlines()[-lines:]))

    def close(self) -> None:
        """Close the pipe. Idempotent."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

"""The lock of a folder that several servers of one machine use: each shares it while it lives."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

SHARED = "shared"
"""What stands for a client's key, where all clients are one user's."""


class SharedUse:
    """This server's share of the lock. The kernel gives it back when the server ends."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "a")  # noqa: SIM115, it goes with this object

    @contextlib.contextmanager
    def alone(self) -> Iterator[bool]:
        """Whether no other server uses the folder, nor begins to in this context.

        Where the file system has no locks, it is never known, and so False.
        """
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            alone = True
        except OSError:
            alone = False
        try:
            yield alone
        finally:
            with contextlib.suppress(OSError):  # a try for more may have lost the share
                fcntl.flock(self._file, fcntl.LOCK_SH)

"""What a ``listen`` writes down for the commands of its machine, for as long as it lives.

The file is locked: a server that is ended by a signal that nobody can catch leaves the file behind,
but the kernel takes the lock back.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import NamedTuple

_NAME = "endpoint"


class Noted(NamedTuple):
    """Where a server listens, its public key as text or ``insecure``, its secret key's file."""

    endpoint: str
    public: str
    key_file: str


class Note:
    """A server's own note. Another server on the same state folder replaces it."""

    def __init__(self, state: Path, noted: Noted) -> None:
        self._path = state / _NAME
        new = state / f".{_NAME}-{os.getpid()}"
        self._file = os.open(new, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        with contextlib.suppress(OSError):  # not every file system has locks: see ``read``
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.write(self._file, f"{' '.join(noted)}\n".encode())
        os.rename(new, self._path)  # whole and locked, or not there

    def remove(self) -> None:
        """Remove it, unless it is another's by now."""
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(self._path.stat(), os.fstat(self._file)):
                self._path.unlink()
        os.close(self._file)


def read(state: Path) -> Noted | None:
    """What the server that runs on a state folder has written down; None if there is none.

    Raises:
        OSError: It may not be read.
        ValueError: Something else lies there.
    """
    try:
        file = os.open(state / _NAME, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    with open(file, encoding="utf-8") as note:
        if not _is_held(file):
            return None
        endpoint, public, key_file = note.read().rstrip("\n").split(" ", 2)
    return Noted(endpoint, public, key_file)


def _is_held(file: int) -> bool:
    """Whether its writer lives; also where the file system does not tell."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    return False

"""A temporary folder of a server, locked for as long as the server lives.

A server that SIGKILL ends leaves its folders behind. The kernel releases the lock, by which the
next server or ``envhub cache gc`` recognises and removes them.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from envhub_worker.lockdown.mechanisms.scratch import remove_tree

_LOCK = "lock"
_NAME = re.compile(r"envhub-([a-z]+-)?[a-z0-9_]{8}")
_SOCKET_BYTES = 107
_LONGEST = "/envhub-12345678/fds"


class LockedFolder:
    """A new private folder with a lock; its owner may open it to others.
    ``parent``: its parent folder; by default the one for temporary files.
    """

    def __init__(self, prefix: str, parent: Path | None = None) -> None:
        self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        new = self.path / f".{_LOCK}"
        self._lock = os.open(new, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        os.rename(new, self.path / _LOCK)  # under that name it is never seen without its lock

    def remove(self) -> None:
        """Remove the folder and its content. Idempotent."""
        with contextlib.suppress(FileNotFoundError):
            remove_tree(str(self.path))
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def place_for_sockets() -> Path:
    """Returns the temporary folder; ``/tmp`` if a socket's path in that would be too long."""
    folder = Path(tempfile.gettempdir())
    return folder if len(os.fsencode(folder)) + len(_LONGEST) <= _SOCKET_BYTES else Path("/tmp")


def remove_deserted(parent: Path) -> None:
    """Remove this project's folders whose server has ended."""
    for path in parent.iterdir():
        with contextlib.suppress(OSError):
            if _NAME.fullmatch(path.name) and path.lstat().st_uid == os.geteuid():
                with unheld(path / _LOCK):
                    remove_tree(str(path))


@contextlib.contextmanager
def unheld(path: str | Path) -> Iterator[None]:
    """Hold a shared lock of a file or folder, so that no server can take it inside the context.
    Raises ``BlockingIOError``: a server holds the lock; ``OSError``: there is no such file, or the
    file system has no locks.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield
    finally:
        os.close(fd)

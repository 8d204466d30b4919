"""The folder with a ``listen``'s keys and snapshots, and its note for commands on its machine.

The server holds a lock on the note for life: a server that SIGKILL ends leaves the file behind, but
the kernel releases the lock.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder

_NAME = "endpoint"


@contextlib.contextmanager
def state_folder(chosen: Path | None) -> Iterator[Path]:
    """A context with the state folder; removes a temporary one that no later server would find."""
    folder = state_dir(chosen, create=True)
    if folder is not None:
        yield folder
        return
    temporary = LockedFolder("envhub-state-")
    try:
        yield temporary.path
    finally:
        temporary.remove()


def state_dir(chosen: Path | None, *, create: bool) -> Path | None:
    """Returns the folder of keys and snapshots, the same for ``listen``, ``health`` and ``status``.

    It is ``chosen``, else ``envhub-worker`` in the user's state folder, else, if that is not
    writable (a read-only container), a temporary folder; None if that fails, too.
    Raises ``OSError``: ``chosen`` cannot be used.
    """
    if chosen is not None:
        if create:
            _make_private(chosen)
        return chosen.absolute()  # jails are made elsewhere, and get the path of their snapshot
    home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    temporary = Path(tempfile.gettempdir()) / f"envhub-worker-{os.getuid()}"
    for candidate in (Path(home) / "envhub-worker", temporary):
        with contextlib.suppress(OSError):
            if create:
                _make_private(candidate)
            if _is_ours(candidate):
                return candidate
    return None


def _make_private(folder: Path) -> None:
    # Root's jails run as another user, who must get through to the snapshots, and no further.
    folder.mkdir(mode=0o711 if os.getuid() == 0 else 0o700, parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written")
    status = folder.stat()
    if status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise PermissionError(
            f"the state folder {folder} holds keys, and others can change it: it belongs to uid "
            f"{status.st_uid} and has mode {stat.S_IMODE(status.st_mode):04o}. Give it to uid "
            f"{os.getuid()} and chmod go-w it, or let --state-dir name a new one"
        )


def _is_ours(folder: Path) -> bool:
    """Whether a folder is ours and only we can write it: others may have made it in ``/tmp``.

    A folder of ours that we cannot write is a read-only container's, and no server uses it.
    """
    status = folder.lstat()
    ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
    return ours and not status.st_mode & 0o022 and os.access(folder, os.W_OK)


class ServerNote(NamedTuple):
    """A server's endpoint, its public key as text or ``insecure``, its secret key's file."""

    endpoint: str
    public: str
    key_file: str


class Note:
    """A server's own note. Another server on the same state folder replaces it."""

    def __init__(self, state: Path, noted: ServerNote) -> None:
        self._path = state / _NAME
        new = state / f".{_NAME}-{os.getpid()}"
        self._file = os.open(new, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        with contextlib.suppress(OSError):  # not every file system has locks: see ``read_note``
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.write(self._file, f"{' '.join(noted)}\n".encode())
        os.rename(new, self._path)  # whole and locked, or not there

    def remove(self) -> None:
        """Remove the note, unless another server has replaced it."""
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(self._path.stat(), os.fstat(self._file)):
                self._path.unlink()
        os.close(self._file)


def read_note(state: Path) -> ServerNote | None:
    """Reads the note of the server that runs on a state folder; None without a server.
    Raises ``OSError``: the note is not readable; ``ValueError``: the file is no note.
    """
    try:
        file = os.open(state / _NAME, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    with open(file, encoding="utf-8") as note:
        # refused while its writer lives, and where the file system has no locks
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return None
        return ServerNote(*note.read().rstrip("\n").split(" ", 2))

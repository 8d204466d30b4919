"""Private folders of servers: where they lie, whose they are, and which are nobody's any more.

Each has sockets, and a socket's path has 107 bytes at most. Its client writes down who it is
before anything else, so that whoever comes later can tell that it has gone: it may be killed at
any moment, also before there is a server that would clean up.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.sandboxes.owner import has_ended, identity_of, is_of_this_boot

SERVER = "envhub-"
CONTAINER = "envhub-docker-"
_NAME = re.compile(rf"{SERVER}(docker-|scratch-|state-)?[a-z0-9_]{{8}}")
_CLIENT_FILE = "client"
_LOCK_FILE = "lock"
_SOCKET_BYTES = 107
_LONGEST = f"/{CONTAINER}12345678/sockets/server"
_EMPTY_S = 60.0
"""Nobody needs so long from a folder to the first file in it."""


def make(prefix: str) -> Path:
    """A new private folder, marked as this process's.

    Raises:
        SandboxUnavailableError: There is no place for one.
    """
    place = next((place for place in places() if _is_usable(place)), None)
    if place is None:
        raise SandboxUnavailableError(
            f"there is no folder for sockets: their paths have {_SOCKET_BYTES} bytes at most, and "
            f"{', '.join(map(str, places()))} are too long or cannot be written; set TMPDIR to a "
            "shorter one"
        )
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
    try:
        (folder / _CLIENT_FILE).write_text(identity_of(os.getpid()))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def places() -> list[Path]:
    """Where they may lie, best first: a short one stands in for a temporary folder that is not."""
    found = [Path(tempfile.gettempdir())]
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.path.isabs(own) and os.geteuid() != 0:  # root's jails, another user, have to get through
        found.append(Path(own))
    return list(dict.fromkeys([*found, Path("/tmp")]))


def _is_usable(place: Path) -> bool:
    path = os.fsencode(place) + os.fsencode(_LONGEST)
    return len(path) <= _SOCKET_BYTES and os.access(place, os.W_OK | os.X_OK)


def stale_folders(place: Path) -> Iterator[Path]:
    """Ours below one of the places that nobody uses any more."""
    for path in sorted(place.glob(f"{SERVER}*")):
        with contextlib.suppress(OSError):
            if _NAME.fullmatch(path.name) and _belongs_to_us(path) and _is_deserted(path):
                yield path


def remove_stale() -> list[Path]:
    """Remove those that were not another machine's, or this one's before it started anew.

    These are for people to judge: a file system may be shared, and its users all live.

    Returns:
        What was removed.
    """
    found = [path for place in places() for path in stale_folders(place)]
    ours = [path for path in found if not _is_elsewhere(path)]
    for path in ours:
        shutil.rmtree(path, ignore_errors=True)
    return ours


def _is_elsewhere(path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        client = (path / _CLIENT_FILE).read_text()
        return bool(client) and not is_of_this_boot(client)
    return False


def _belongs_to_us(path: Path) -> bool:
    status = path.lstat()
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.geteuid()
        and status.st_mode & 0o066 == 0
    )


def _is_deserted(path: Path) -> bool:
    """Whether its client has ended, or the server that had no client of its own."""
    names = set(os.listdir(path))
    if _CLIENT_FILE in names:
        client = (path / _CLIENT_FILE).read_text()
        return has_ended(client) is True if client else _is_forgotten(path)
    if _LOCK_FILE in names:
        return _is_unlocked(path / _LOCK_FILE)
    return not names and _is_forgotten(path)


def _is_forgotten(path: Path) -> bool:
    return time.time() - path.stat().st_mtime > _EMPTY_S


def _is_unlocked(path: Path) -> bool:
    """Whether nobody holds the lock that ``envhub-worker listen`` holds as long as it lives."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True

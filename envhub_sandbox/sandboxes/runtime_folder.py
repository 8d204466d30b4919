"""Private folders of servers: where they lie, and which of them no process uses any more.

Each has sockets, and a socket's path has 107 bytes at most. Its client holds the lock of a file in
it for as long as it lives, so that others can tell later that it has gone: it may be killed
at any moment, also before there is a server that would clean up. Containers name such a folder.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.system.locks import LifeLock, is_held
from envhub_sandbox.system.platform import IS_LINUX, IS_WINDOWS, boot_id, user_id

SERVER = "envhub-"
CONTAINER = "envhub-docker-"
_NAME = re.compile(rf"{SERVER}(docker-|scratch-|state-)?[a-z0-9_]{{8}}")
_CLIENT_FILE = "alive"
_LOCK_FILE = "lock"
_BEGUN = {f".{_CLIENT_FILE}", f".{_LOCK_FILE}"}
_SOCKET_BYTES = 107
_LONGEST = f"/{CONTAINER}12345678/sockets/server"
_EMPTY_S = 60.0
"""No client needs so long from a folder to the first file in it."""


class RuntimeFolder:
    """A new private folder, which is in use as long as this process lives.
    ``prefix``: what its name begins with.
    Raises ``SandboxUnavailableError``: there is no place for one.
    """

    def __init__(self, prefix: str) -> None:
        self.path = _made(prefix)
        try:
            self._lock = LifeLock(self.path / _CLIENT_FILE, f"{boot_id()} {os.getpid()}\n")
        except BaseException:
            shutil.rmtree(self.path, ignore_errors=True)
            raise

    def has_sockets(self, *names: str) -> bool:
        """Whether all of these are there: others may remove temporary files that look old."""
        return all((self.path / name).is_socket() for name in names)

    def remove(self) -> None:
        """Remove it, with all that is in it. Idempotent."""
        self._lock.release()  # first: Windows removes no file that is open
        shutil.rmtree(self.path, ignore_errors=True)


def _made(prefix: str) -> Path:
    """A new folder in the first place that takes one: whether it does only an attempt can tell."""
    why = ""
    for place in places():
        if _is_short(place):
            try:
                return Path(tempfile.mkdtemp(prefix=prefix, dir=place))
            except OSError as error:
                why = why or f" ({error.strerror}: {place})"
    raise SandboxUnavailableError(
        f"no folder can be used for sockets: their paths can have {_SOCKET_BYTES} bytes at most, "
        f"and {', '.join(map(str, places()))} are too long or not writable{why}; set TMPDIR to a "
        "shorter path, or to a writable folder (in a container: --tmpfs /tmp)"
    )


def places() -> list[Path]:
    """Where they may lie, best first: a short one stands in for a temporary folder that is not."""
    found = []
    with contextlib.suppress(FileNotFoundError):  # nothing can be written here
        found.append(Path(tempfile.gettempdir()))
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.path.isabs(own) and user_id() != 0:  # root's jails, another user, have to get through
        found.append(Path(own))
    return list(dict.fromkeys([*found, *([] if IS_WINDOWS else [Path("/tmp")])]))


def _is_short(place: Path) -> bool:
    if not IS_LINUX:  # there it holds no sockets
        return True
    return len(os.fsencode(place) + os.fsencode(_LONGEST)) <= _SOCKET_BYTES


def stale_folders(place: Path) -> Iterator[Path]:
    """Ours below one of the places whose client has ended, or the server without a client."""
    for path in sorted(place.glob(f"{SERVER}*")):
        with contextlib.suppress(OSError):
            if _NAME.fullmatch(path.name) and _belongs_to_us(path) and _is_deserted(path):
                yield path


def remove_stale() -> list[Path]:
    """Remove those that were not another machine's, or this one's before it started anew.

    These are for people to judge: a file system may be shared, and not pass locks on.

    Returns:
        What was removed.
    """
    found = [path for place in places() for path in stale_folders(place)]
    ours = [path for path in found if not _is_elsewhere(path)]
    for path in ours:
        shutil.rmtree(path, ignore_errors=True)
    return ours


def is_in_use(path: Path) -> bool:
    """Whether the client of a folder lives.
    Raises ``FileNotFoundError``: it is no folder of a client, or not one of this machine;
    ``OSError``: that cannot be known.
    """
    if not (path.is_absolute() and _NAME.fullmatch(path.name)):
        raise FileNotFoundError(errno.ENOENT, "it is no runtime folder", str(path))
    return is_held(path / _CLIENT_FILE)


def _is_elsewhere(path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return boot_id() not in (path / _CLIENT_FILE).read_text()
    return False


def _belongs_to_us(path: Path) -> bool:
    status = path.lstat()
    mine = IS_WINDOWS or (status.st_uid == user_id() and status.st_mode & 0o066 == 0)
    return stat.S_ISDIR(status.st_mode) and mine


def _is_deserted(path: Path) -> bool:
    names = set(os.listdir(path))
    for name in (_CLIENT_FILE, _LOCK_FILE):
        if name in names:
            return not is_held(path / name)
    # its client was killed before its first file had that name
    return names <= _BEGUN and time.time() - path.stat().st_mtime > _EMPTY_S

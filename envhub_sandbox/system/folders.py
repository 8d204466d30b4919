"""Our folders and files on disk, and the user's cache folder, which has most of them.

Folders get explicit modes, whatever the umask is, and are trusted only if no other user can write
in them. A umask of 0 would let others in, and 077 would keep a worker of another user out. The
umask belongs to the whole process, so it is never changed here. On Windows a mode says only whether
a file can be written. Its access list, which it inherits, says who owns and who may write it: files
in a user's own folders belong to that user.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shlex
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.system.platform import IS_WINDOWS, open_flags, user_id

if sys.platform != "win32":
    import grp
    import pwd


SHARED_MODE = 0o755
PRIVATE_MODE = 0o700
_PRIVATE_FILE_MODE = 0o600
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_MAX_LINKS = 40
_ACL = "system.posix_acl_access"


def make(folder: Path, mode: int = SHARED_MODE) -> None:
    """Make a folder, and missing folders above it (0755), whatever the umask is.

    An existing folder keeps its mode.
    Raises ``OSError``: it cannot be made.
    """
    missing = []
    above = folder
    while not above.is_dir():
        missing.append(above)
        above = above.parent
    for path in reversed(missing):
        try:
            os.mkdir(path, PRIVATE_MODE)
        except FileExistsError:
            if not path.is_dir():
                raise
        else:
            os.chmod(path, mode if path == folder else SHARED_MODE)


def make_private(folder: Path) -> None:
    """Make a folder that only we can use; an existing folder gets this mode, too.
    Raises ``OSError``: it cannot be made, or belongs to another user.
    """
    make(folder, PRIVATE_MODE)
    if stat.S_IMODE(folder.stat().st_mode) != PRIVATE_MODE:
        os.chmod(folder, PRIVATE_MODE)


def write_private(path: Path, content: bytes) -> None:
    """Write a new file that only its owner may read, whatever the umask is. Raises ``OSError``."""
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _PRIVATE_FILE_MODE)
    with os.fdopen(fd, "wb") as file:
        if sys.platform != "win32":
            os.fchmod(fd, _PRIVATE_FILE_MODE)
        file.write(content)


def why_distrusted(folder: Path, ours: Path) -> str:
    """Which user besides us and root can change a path, with advice; empty if none can.

    Every step of the path is checked, also links and their targets, because a user who can write in
    a folder can replace its entries. In a sticky folder, such as /tmp, only the owner of an entry
    can replace it, so there the owner of the next step is checked. The group bits show a POSIX
    access list, whose mask they are.
    ``place``: an existing absolute path.
    ``ours``: the topmost folder that we made: in it no other user may write. Above it the group may
    write if it is the user's own group, as many systems configure home directories.
    Raises ``OSError``: the status of a step cannot be read.
    """
    if IS_WINDOWS:
        folder.stat()
        return ""
    inner = os.path.realpath(ours)
    for path, status in _steps(folder):
        strict = path == inner or path.startswith(f"{inner}/")
        fault = _fault(path, status, strict)
        if fault:
            return fault
    return ""


def _steps(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Yield each step of a path from the root on; after a link, each step of its target."""
    left, current, links = list(reversed(folder.parts[1:])), "/", 0
    yield current, os.lstat(current)
    while left:
        step = left.pop()
        if step == "..":
            current = os.path.dirname(current)
            continue
        path = os.path.join(current, step)
        status = os.lstat(path)
        yield path, status
        if not stat.S_ISLNK(status.st_mode):
            current = path
            continue
        links += 1
        if links > _MAX_LINKS:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), path)
        target = os.readlink(path)
        current = "/" if target.startswith("/") else current
        left += [part for part in reversed(target.split("/")) if part not in ("", ".")]


def _fault(path: str, status: os.stat_result, strict: bool) -> str:
    if stat.S_ISCHR(status.st_mode):
        return ""  # such as /dev/null, a home in name only, whose mode is everybody's concern
    kind = "link" if stat.S_ISLNK(status.st_mode) else "folder"
    kind = "file" if stat.S_ISREG(status.st_mode) else kind
    quoted = shlex.quote(path)
    if not is_trusted(status.st_uid):
        mend = f"If you trust them with it: chown {'-h ' * (kind == 'link')}{user_id()} {quoted}"
        return f"the {kind} {path} belongs to {_user(status.st_uid)}. {mend}"
    mode = stat.S_IMODE(status.st_mode)
    if kind == "link" or not mode & _OTHERS_WRITE or (mode & stat.S_ISVTX and not strict):
        return ""
    if not mode & stat.S_IWOTH and not strict and _is_own_group(path, status):
        return ""
    who = "everybody" if mode & stat.S_IWOTH else f"the group {_group(status.st_gid)}"
    return (
        f"the {kind} {path} can be written by {who} (mode {mode:04o}). "
        f"If none has done so: chmod go-w {quoted}"
    )


def is_ours_alone(folder: Path) -> bool:
    """Whether only the owner can write in a folder, and is us or root. Raises ``OSError``."""
    status = folder.stat()
    return is_trusted(status.st_uid) and not others_write(status)


def others_write(status: os.stat_result) -> bool:
    """Whether users other than the owner can write a file, or in a folder."""
    return not IS_WINDOWS and bool(status.st_mode & _OTHERS_WRITE)


def is_trusted(user: int) -> bool:
    """Whether a user could change our files anyway: ourselves, root, and the owner of ``/``.

    The owner of ``/`` is root, as seen in a user namespace. On Windows all users have the number 0.
    """
    return user == 0 or user == user_id() or user == os.lstat("/").st_uid


def _is_own_group(path: str, status: os.stat_result) -> bool:
    """Whether a group has only us as a member, and no access list adds other users."""
    if user_id() == 0 or _has_access_list(path):
        return False
    is_own = False
    if sys.platform != "win32":
        with contextlib.suppress(KeyError):
            group, owner = grp.getgrgid(status.st_gid), pwd.getpwuid(user_id())
            others = [user for user in pwd.getpwall() if user.pw_gid == group.gr_gid]
            is_own = (
                group.gr_gid == owner.pw_gid
                and set(group.gr_mem) <= {owner.pw_name}
                and all(user.pw_uid == owner.pw_uid for user in others)
            )
    return is_own


def _has_access_list(path: str) -> bool:
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            return _ACL in os.listxattr(path)
    return False


def _user(uid: int) -> str:
    if sys.platform != "win32":
        with contextlib.suppress(KeyError):
            return f"the user {pwd.getpwuid(uid).pw_name} (uid {uid})"
    return f"uid {uid}"


def _group(gid: int) -> str:
    if sys.platform != "win32":
        with contextlib.suppress(KeyError):
            return f"{grp.getgrgid(gid).gr_name} (gid {gid})"
    return str(gid)


_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | open_flags("O_CLOEXEC")


def write_whole_file(path: Path, data: bytes, *, mode: int = 0o600) -> None:
    """Write a file under another name, and rename it, so that readers never see a part of it.
    ``mode``: the file's mode, reduced by the umask.
    Raises ``OSError``: it cannot be written; nothing is left of it.
    """
    part = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    descriptor = os.open(part, _NEW, mode)
    try:
        with open(descriptor, "wb") as file:
            file.write(data)
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise


CACHE_VARIABLE = "ENVHUB_CACHE"
BUILDING = ".building-"
_MAX_TEXT_BYTES = 16 * 1024 * 1024


def cache_root() -> Path:
    """``$ENVHUB_CACHE``, or the user's cache folder for ``envhub-sandbox``.
    Raises ``SnapshotError``: the user has no home folder.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen:
        return Path(os.path.abspath(os.path.expanduser(chosen)))
    import platformdirs

    try:
        return Path(platformdirs.user_cache_dir("envhub-sandbox", appauthor=False))
    except RuntimeError:
        raise SnapshotError(
            f"this user has no home folder for the cache; set {CACHE_VARIABLE} to a folder"
        ) from None


@contextlib.contextmanager
def draft(folder: Path, prefix: str = BUILDING) -> Iterator[Path]:
    """Make a folder (0700) to fill and rename; it is removed unless the caller renames it."""
    draft_folder = Path(tempfile.mkdtemp(prefix=prefix, dir=folder))
    try:
        yield draft_folder
    finally:
        remove_tree(draft_folder)


def remove_tree(path: Path) -> None:
    """Remove a folder of the cache, with its read-only folders; no error if it does not exist.

    Unlike ``shutil.rmtree`` it does not recurse, since a stranger chose how deep a package is.
    """
    waiting = [] if path.is_symlink() else [str(path)]
    for folder in waiting:  # the loop appends to it
        with contextlib.suppress(OSError):
            os.chmod(folder, 0o700)
            with os.scandir(folder) as items:
                waiting += [item.path for item in items if item.is_dir(follow_symlinks=False)]
    for folder in reversed(waiting):
        with contextlib.suppress(OSError):
            for name in os.listdir(folder):
                with contextlib.suppress(OSError):
                    file = os.path.join(folder, name)
                    if IS_WINDOWS:  # Windows cannot remove a read-only file
                        os.chmod(file, PRIVATE_MODE)
                    os.unlink(file)
            os.rmdir(folder)


def recall(folder: Path, key: str) -> str | None:
    """A text that ``keep`` wrote; None if there is none, or another user could have written it."""
    path = folder / key
    try:
        if not is_ours_alone(folder) or path.stat().st_size > _MAX_TEXT_BYTES:
            return None
        return path.read_text("utf-8")
    except (OSError, ValueError):
        return None


def keep(folder: Path, key: str, text: str) -> None:
    """Write a text for ``recall``. Failing to write the cache is no error."""
    with contextlib.suppress(OSError):
        make_private(folder)
        write_whole_file(folder / key, text.encode())

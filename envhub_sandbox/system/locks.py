"""Locks on files, which the kernel releases when their holder ends for any reason.

All are ``flock``. Such a lock belongs to the open file description, not to a process: a child that
inherits the descriptor keeps the lock held, and a fork would, too, so it closes its copies. Unlike
a pid or a start time, a lock also has a meaning in another namespace.

Windows locks bytes of a file exclusively, so a shared lock does nothing there.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path

from envhub_sandbox.system.platform import each_after_fork, open_flags

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_POLL_S = 0.1
_COMMAND_CHARS = 80
_LOOKS = 5
"""How often to read the list of locks: the kernel gives it page by page, and may skip some when
others change it."""
_READ = os.O_RDONLY | open_flags("O_NONBLOCK", "O_NOFOLLOW", "O_CLOEXEC")
_WRITE = os.O_RDWR | os.O_CREAT | open_flags("O_NOFOLLOW", "O_CLOEXEC")
_LOCKED_BYTE = 1 << 30
"""The byte to lock on Windows, where locked bytes cannot be read: beyond the end of our files."""


def lock(descriptor: int, *, shared: bool = False, wait: bool = False) -> None:
    """Take the lock of an open file. Raises ``BlockingIOError``: another process has it, and
    ``wait`` is False; ``OSError``: its file system has no locks.
    """
    if sys.platform == "win32":
        if not shared:
            _lock_byte(descriptor, msvcrt.LK_NBLCK)
    else:
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        fcntl.flock(descriptor, kind if wait else kind | fcntl.LOCK_NB)


def _lock_byte(descriptor: int, how: int) -> None:
    if sys.platform == "win32":
        before = os.lseek(descriptor, 0, os.SEEK_CUR)
        os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, how, 1)
        except PermissionError as error:
            raise BlockingIOError(*error.args) from error
        finally:
            os.lseek(descriptor, before, os.SEEK_SET)


@contextlib.contextmanager
def held(
    path: Path,
    *,
    wait_s: float = 0.0,
    on_wait: Callable[[], object] = lambda: None,
    mode: int = 0o600,
) -> Iterator[int]:
    """Hold the lock of a file, which is made if it does not exist. Yields its descriptor.

    A child that inherits the descriptor keeps the lock only until this context ends. The holder
    may remove the file; the next holder then makes a new one.

    Args:
        wait_s: How long to wait while another process holds it.
        on_wait: Called once before the first wait.
        mode: The mode of a new file.

    Raises ``TimeoutError``: another process holds it; ``OSError``: the file cannot be opened, or
    its file system has no locks.
    """
    until = time.monotonic() + wait_s
    waits = False
    while (descriptor := _take(path, mode)) is None:
        if time.monotonic() >= until:
            raise TimeoutError(f"another process holds the lock {path}")
        if not waits:
            waits = True
            on_wait()
        time.sleep(_POLL_S)
    try:
        yield descriptor
    finally:  # a close alone would keep it locked while a fork has a copy of the descriptor
        if sys.platform == "win32":
            _lock_byte(descriptor, msvcrt.LK_UNLCK)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_UN)
        os.close(descriptor)


def _take(path: Path, mode: int) -> int | None:
    """Take the lock now; None if another process has it, or has just removed the file."""
    descriptor = os.open(path, _WRITE, mode)
    try:
        lock(descriptor)
        # A holder that removed the file meanwhile leaves us the lock of a file without a name.
        if os.path.samestat(os.fstat(descriptor), os.stat(path)):
            return descriptor
    except (BlockingIOError, FileNotFoundError):
        pass
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


def is_held(path: Path) -> bool:
    """Whether a process, in any namespace, holds the file's lock exclusively.
    Raises ``FileNotFoundError``: the file does not exist; ``OSError``: it cannot be opened, or its
    file system has no locks.
    """
    with unheld(path) as free:
        return not free


@contextlib.contextmanager
def unheld(path: Path) -> Iterator[bool]:
    """Whether the lock is free; nobody can take it within this context. Raises as ``is_held``."""
    descriptor = os.open(path, _READ)
    try:
        lock(descriptor, shared=sys.platform != "win32")
        free = True
    except BlockingIOError:
        free = False
    except BaseException:
        os.close(descriptor)
        raise
    try:
        yield free
    finally:
        os.close(descriptor)


class _HeldLock:
    """A lock that this process holds until ``release``, or until nothing refers to this object.

    A fork does not hold it.
    """

    def __init__(self) -> None:
        self._held: list[int] = []  # the descriptor; empty once it is released
        _locks.add(self)
        # interruption.md, rule 5: also if a Ctrl-C has interrupted ``release``
        weakref.finalize(self, _close, self._held).atexit = False

    def release(self) -> None:
        """Release the lock. Idempotent. In a fork, only close the copy of its descriptor."""
        _close(self._held)


class LifeLock(_HeldLock):
    """A new file whose lock this process holds; it gets its name only when it is locked.

    If the file system has no locks, ``is_held`` raises.
    """

    def __init__(self, path: Path, content: str = "") -> None:
        super().__init__()
        # Windows cannot rename an open file
        new = path if sys.platform == "win32" else path.with_name(f".{path.name}")
        self._held.append(os.open(new, _WRITE | os.O_EXCL, 0o600))
        with contextlib.suppress(OSError):
            lock(self._held[0])
        os.write(self._held[0], content.encode())
        if new != path:
            os.rename(new, path)


class SharedLock(_HeldLock):
    """A file's lock that this process shares with others that use the file; see ``sharers``.

    Nothing is held if the file does not exist or another process holds the lock exclusively.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        with contextlib.suppress(OSError):
            self._held.append(os.open(path, _READ))
            lock(self._held[0], shared=True)


def sharers(path: Path) -> dict[int, str]:
    """The processes that hold the lock of a file, as far as this namespace shows them: from the pid
    to the beginning of the command line. Empty if the kernel has no list of locks.
    """
    if sys.platform != "linux":
        return {}
    status = path.stat()
    device = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    held: set[int] = set()
    for _ in range(_LOOKS):
        rows = [row.split() for row in Path("/proc/locks").read_text().splitlines()]
        held = {int(row[4]) for row in rows if row[1] == "FLOCK" and row[5] == device}
        if held:
            break
    return {pid: _command(pid) for pid in sorted(held) if pid > 0}


def _command(pid: int) -> str:
    with contextlib.suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
        return words.decode("utf-8", "replace").strip()[:_COMMAND_CHARS]
    return ""


def _close(held: list[int]) -> None:
    while held:
        os.close(held.pop())


# interruption.md, rules 14 and 15
_locks: weakref.WeakSet[_HeldLock] = weakref.WeakSet()
each_after_fork(_locks, _HeldLock.release)

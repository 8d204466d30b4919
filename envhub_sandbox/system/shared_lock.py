"""A lock that several processes share while they use a file, and who they are."""

from __future__ import annotations

import contextlib
import fcntl
import os
import weakref
from pathlib import Path

_COMMAND_CHARS = 80
_LOOKS = 5
"""The kernel gives the list of locks a page at a time, and skips some where others change it."""


class SharedLock:
    """A file's lock that this process shares until ``release``, or until nobody has this object.

    A fork does not hold it. Nothing is held where there is no such file, or another has it alone.
    """

    def __init__(self, path: Path) -> None:
        self._held: list[int] = []
        _shared.add(self)
        # what a Ctrl-C keeps ``release`` from, this does, which is called whatever became of that
        weakref.finalize(self, _close, self._held).atexit = False
        with contextlib.suppress(OSError):
            self._held.append(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC))
            fcntl.flock(self._held[0], fcntl.LOCK_SH | fcntl.LOCK_NB)

    def release(self) -> None:
        """Give it back. Idempotent, and nothing in a fork."""
        _close(self._held)


def sharers(path: Path) -> dict[int, str]:
    """The processes that hold the lock of a file, as far as they are seen from here.

    Returns:
        Pid to the first words of the command line.
    """
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


_shared: weakref.WeakSet[SharedLock] = weakref.WeakSet()


def _close(held: list[int]) -> None:
    while held:
        os.close(held.pop())


def _forked() -> None:
    for lock in _shared:
        lock.release()


os.register_at_fork(after_in_child=_forked)

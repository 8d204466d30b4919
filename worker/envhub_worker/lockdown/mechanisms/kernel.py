"""System calls that the standard library lacks, through ctypes."""

from __future__ import annotations

import ctypes
import os
import struct

from envhub_worker.lockdown.seccomp.syscalls import syscall_number

_libc = ctypes.CDLL(None, use_errno=True)
_libc.syscall.restype = ctypes.c_long

CLONE_NEWNS = 0x00020000
CLONE_NEWCGROUP = 0x02000000
CLONE_NEWUTS = 0x04000000
CLONE_NEWIPC = 0x08000000
CLONE_NEWUSER = 0x10000000
CLONE_NEWPID = 0x20000000
CLONE_NEWNET = 0x40000000

MS_NOSUID, MS_NODEV, MS_NOEXEC = 2, 4, 8
MS_REC, MS_PRIVATE = 1 << 14, 1 << 18
MNT_DETACH = 2

ATTR_RDONLY, ATTR_NOSUID, ATTR_NODEV, ATTR_NOEXEC = 1, 2, 4, 8
ATTR_IDMAP = 1 << 20

_AT_FDCWD = -100
_AT_EMPTY_PATH = 0x1000
_AT_RECURSIVE = 0x8000
_OPEN_TREE_CLONE = 1
_OPEN_TREE_CLOEXEC = os.O_CLOEXEC
_MOVE_MOUNT_F_EMPTY_PATH = 4

_CAPABILITY_VERSION_3 = 0x20080522


def syscall(
    name: str, *args: int | bytes | ctypes.Array[ctypes.c_char] | None, path: str | None = None
) -> int:
    """Make a system call. Integers are passed as longs, bytes as pointers.
    Raises ``OSError``, which names ``path``.
    """
    words = [ctypes.c_long(arg) if isinstance(arg, int) else arg for arg in args]
    return _checked(_libc.syscall(ctypes.c_long(syscall_number(name)), *words), path)


def prctl(option: int, *args: int) -> int:
    """``prctl(2)`` with the unused arguments zero, as newer options demand."""
    words = [ctypes.c_ulong(arg) for arg in (*args, 0, 0, 0, 0)[:4]]
    return _checked(_libc.prctl(ctypes.c_int(option), *words))


def unshare(flags: int) -> None:
    """``unshare(2)``."""
    _checked(_libc.unshare(ctypes.c_int(flags)))


def setns(fd: int, flags: int) -> None:
    """``setns(2)``; ``fd`` may be a pidfd."""
    _checked(_libc.setns(ctypes.c_int(fd), ctypes.c_int(flags)))


def mount(source: str, target: str, kind: str, flags: int = 0, options: str = "") -> None:
    """``mount(2)``. The error names the target."""
    words = (os.fsencode(source), os.fsencode(target), kind.encode())
    data = os.fsencode(options) or None
    _checked(_libc.mount(*words, ctypes.c_ulong(flags), data), target)


def unmount(target: str) -> None:
    """Detach the mount at ``target`` now; the kernel frees it after its last use."""
    _checked(_libc.umount2(os.fsencode(target), ctypes.c_int(MNT_DETACH)), target)


def pivot_root(new_root: str, put_old: str) -> None:
    """``pivot_root(2)``."""
    syscall("pivot_root", os.fsencode(new_root), os.fsencode(put_old))


def clone_tree(path: str) -> int:
    """Returns a descriptor of a detached copy of the mounts at and below ``path``."""
    flags = _OPEN_TREE_CLONE | _OPEN_TREE_CLOEXEC | _AT_RECURSIVE
    return syscall("open_tree", _AT_FDCWD, os.fsencode(path), flags, path=path)


def restrict_tree(tree: int, attributes: int, *, userns: int = 0) -> None:
    """Add mount ``attributes`` (``ATTR_*``) to the detached ``tree``."""
    words = struct.pack("=QQQQ", attributes, 0, 0, userns)
    syscall("mount_setattr", tree, b"", _AT_EMPTY_PATH | _AT_RECURSIVE, words, len(words))


def restrict_mount(path: str, attributes: int) -> None:
    """Add mount ``attributes`` to the mount at ``path``, without those below it."""
    words = struct.pack("=QQQQ", attributes, 0, 0, 0)
    syscall("mount_setattr", _AT_FDCWD, os.fsencode(path), 0, words, len(words))


def attach_tree(tree: int, path: str) -> None:
    """Attach the detached ``tree`` at ``path``; the descriptor stays the caller's."""
    words = (b"", _AT_FDCWD, os.fsencode(path), _MOVE_MOUNT_F_EMPTY_PATH)
    syscall("move_mount", tree, *words, path=path)


def capget() -> tuple[int, int, int]:
    """This thread's (effective, permitted, inheritable) capabilities as bit masks."""
    header = struct.pack("=Ii", _CAPABILITY_VERSION_3, 0)
    data = ctypes.create_string_buffer(24)
    syscall("capget", header, data)
    words = struct.unpack("=6I", data.raw)
    effective, permitted, inheritable = (words[n] | words[n + 3] << 32 for n in range(3))
    return effective, permitted, inheritable


def capset_none() -> None:
    """Empty this thread's three sets."""
    syscall("capset", struct.pack("=Ii", _CAPABILITY_VERSION_3, 0), bytes(24))


def _checked(result: int, path: str | None = None) -> int:
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error), path)
    return int(result)

"""Finds which files and processes a waiting call names, for the record only: it decides nothing.

The kernel always continues a call that names a file, and the kernel alone decides it, by mounts and
Landlock. This module reads the path from a stranger's memory a moment later, when another thread
may have changed it: so a path is evidence of an attempt, but no proof. A process's pid is in a
register, so the kernel reads the same; whether the call may reach that process is decided by the
kernel, or by ``notify``.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
from collections.abc import Callable, Collection, Sequence
from typing import BinaryIO

from envhub_worker.extras.denials.targets import never_a_target
from envhub_worker.lockdown.seccomp.syscalls import NAMED, c_int
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import printable

_LONGEST_PATH = 4096
_PAGE = 4096
_SHOWN = 200
_AT_FDCWD = -100
_AF_UNIX = 1
_SOCKET_ADDRESS = 110

_FLAGS = {"open": 1, "openat": 2}
_ADDRESS = {"connect": (1, 2), "sendto": (4, 5)}
_CHANGING = os.O_ACCMODE | os.O_CREAT | os.O_TRUNC

_PRIVATE = re.compile(
    r"/(home|root|Users|run/user|run/secrets|var/(run|log|mail|spool|backups)"
    r"|etc/(shadow|gshadow|sudoers|sudoers\.d|ssh|ssl/private))(/.*)?"
    r"|/proc/\d+(/task/\d+)?/(environ|mem|maps|smaps|auxv|io|fd|fdinfo|root|cwd|ns)(/.*)?",
    re.DOTALL,
)
"""Private files: reading one is worth a report. Libraries look for settings elsewhere."""
_DOORS = re.compile(r"/proc/(?:self|thread-self|\d+)(?:/task/\d+)?/(root|cwd|fd/\d+)")
"""Entries of a process in /proc that lead to another place, like symbolic links."""
_MOST_STEPS = 128
_DEEPEST = 16
"""Links are looked at so far below a folder of the jail's own."""
_NO_FOLLOW = 0x100
_FLAGS_OF_AT = {"fchmodat2": 3, "utimensat": 3, "fchownat": 4}
_FOLLOWING = "creat truncate chmod fchmodat chown setxattr removexattr"
_HARMLESS = ("/var/run/nscd/socket", "/run/nscd/socket")
"""The C library asks there who a user is."""


@dataclass(frozen=True, kw_only=True)
class OwnPaths:
    """The paths that a jail's processes may use.

    Attributes:
        changed: Folders and files that the processes may change.
        read: Folders and files that they may read.
        scratch: Folders in which they may have created symbolic links.
    """

    changed: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    scratch: tuple[str, ...] = ()


def asked(
    call: str, words: Sequence[int], thread: int, own: OwnPaths, still_waits: Callable[[], object]
) -> list[tuple[str, str]]:
    """Returns the targets of a waiting call outside its jail: the action, and each printable path.

    Args:
        call: The name of the call, one of ``NAMED``.
        words: Its arguments, as in the registers.
        still_waits: Raises OSError if the caller has ended: its pid may belong to another process.
    """
    with contextlib.suppress(OSError, ValueError, OverflowError):
        with open(f"/proc/{thread}/mem", "rb", buffering=0) as memory:
            still_waits()  # after opening: the descriptor pins this caller's memory
            if call in _ADDRESS:
                address, size = (words[index] for index in _ADDRESS[call])
                path = _addressed(memory, address, size, thread, own)
                harmless = not path or path in _HARMLESS or _is_within(path, own.changed)
                return [] if harmless else [(call, _shown(path))]
            deed, last = _deed(call, words)
            paths = [_named(memory, thread, words, own, last, *where) for where in NAMED[call]]
        return [(deed, _shown(path)) for path in paths if path and not _may(deed, path, own)]
    return []


def _deed(call: str, words: Sequence[int]) -> tuple[str, bool]:
    """Returns a call's action, and whether it follows a link at the end of its path."""
    if call in _FLAGS:
        flags = words[_FLAGS[call]]
    elif call in _FLAGS_OF_AT:
        return call, not words[_FLAGS_OF_AT[call]] & _NO_FOLLOW
    else:
        return "write" if call == "creat" else call, call in _FOLLOWING.split()
    makes = os.O_CREAT | os.O_EXCL
    last = not flags & os.O_NOFOLLOW and flags & makes != makes
    return "write" if flags & _CHANGING else "read", last


def _named(
    memory: BinaryIO,
    thread: int,
    words: Sequence[int],
    own: OwnPaths,
    last: bool,
    folder: int | None,
    path: int,
) -> str:
    """Reads the path at an address; empty if there is no text or it has no end."""
    text = _text(memory, words[path])
    if not text:
        return ""
    number = _AT_FDCWD if folder is None else c_int(words[folder])
    base = "cwd" if number == _AT_FDCWD else f"fd/{number}"
    return _absolute(thread, base, text, own, last=last)


def _text(memory: BinaryIO, address: int) -> bytes:
    text = b""
    while b"\0" not in text and len(text) < _LONGEST_PATH:
        more = os.pread(
            memory.fileno(), _PAGE - address % _PAGE, address
        )  # the next may be no page
        if not more:
            return b""
        text, address = text + more, address + len(more)
    text, end, _ = text.partition(b"\0")
    return text if end and len(text) < _LONGEST_PATH else b""


def _absolute(thread: int, base: str, text: bytes, own: OwnPaths, *, last: bool) -> str:
    """Returns the absolute path, from the caller's base folder; empty if the base is no folder.

    Follows links in the jail's own folders, at the end of the path only if ``last``. Their targets
    are taken as names and not looked up. Another thread may change the links meanwhile.
    """
    path = os.fsdecode(text)
    if not path.startswith("/"):
        path = os.path.join(os.readlink(f"/proc/{thread}/{base}"), path)
    done: list[str] = []
    pending = path.split("/")[::-1]
    for _ in range(_MOST_STEPS if path.startswith("/") else 0):
        name = pending.pop()
        if name == "..":
            done = done[:-1]
        elif name not in ("", "."):
            done.append(name)
            leads = _leads(thread, f"/{'/'.join(done)}", own, pending, last=last)
            if leads:
                done = [] if leads.startswith("/") else done[:-1]
                pending += leads.split("/")[::-1]
        if not pending:
            return f"/{'/'.join(done)}"
    return f"/...{path}" if path.startswith("/") else ""  # wherever that is: not its own


def _leads(thread: int, path: str, own: OwnPaths, pending: Sequence[str], *, last: bool) -> str:
    """Returns the target of an entry of /proc or of a link in the jail's own folders; else empty.
    Raises ``ValueError``: the entry leads to something without a path, such as a socket.
    """
    door = _DOORS.fullmatch(path)
    if door is not None and pending:
        leads = "/" if door[1] == "root" else os.readlink(f"/proc/{thread}/{door[1]}")
        if not leads.startswith("/"):
            raise ValueError(leads)
        return leads
    if pending or last:
        for folder in own.scratch:
            if path.startswith(f"{folder}/"):
                return _link(thread, folder, path[len(folder) + 1 :].split("/"))
    return ""


def _link(thread: int, folder: str, names: Sequence[str]) -> str:
    """Returns the target of a link; empty for other files. Follows no link on the way to it."""
    if len(names) > _DEEPEST:
        return ""
    descriptor = os.open(f"/proc/{thread}/root{folder}", os.O_PATH | os.O_DIRECTORY)
    try:
        for name in names[:-1]:
            outer = descriptor
            descriptor = os.open(name, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=outer)
            os.close(outer)
        return os.readlink(names[-1], dir_fd=descriptor)
    except OSError:
        return ""
    finally:
        os.close(descriptor)


def _addressed(memory: BinaryIO, start: int, size: int, thread: int, own: OwnPaths) -> str:
    """Returns a socket's file; empty for a socket without a file: that is in the jail's network."""
    address = os.pread(memory.fileno(), min(size & 0xFFFFFFFF, _SOCKET_ADDRESS), start)
    text = address[2:].partition(b"\0")[0]
    if address[:2] != struct.pack("=H", _AF_UNIX) or not text:
        return ""
    return _absolute(thread, "cwd", text, own, last=True)


def _may(deed: str, path: str, own: OwnPaths) -> bool:
    if deed == "read":
        is_private = _PRIVATE.fullmatch(path) is not None or never_a_target(path)
        return not is_private or _is_within(path, own.read)
    return _is_within(path, own.changed)


def _is_within(path: str, folders: Collection[str]) -> bool:
    return any(path == folder or path.startswith(f"{folder}/") for folder in folders)


def _shown(path: str) -> str:
    text = printable(path.encode(errors="backslashreplace").decode())[:_SHOWN]
    return text.replace("\n", "\\n").replace("\t", "\\t")

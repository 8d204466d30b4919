"""Facts about processes from ``/proc/PID``, which only this module reads."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping, Sequence

Children = Mapping[int, Sequence[int]]
"""The children of every process that has some."""


def pids() -> list[int]:
    """Every process of this pid namespace."""
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]


def stat(pid: int) -> list[bytes]:
    """Returns the words of ``/proc/PID/stat`` (proc(5)) from the state on; raises OSError."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        # The command may hold anything, parentheses and blanks included.
        return file.read().rpartition(b")")[2].split()


def content(path: str) -> bytes:
    """Returns the content of a file of ``/proc``; empty if its process has ended."""
    try:
        with open(path, "rb") as file:
            return file.read()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def text(path: str) -> str | None:
    """Returns the text of a small file, such as a setting; None if it cannot be read."""
    with contextlib.suppress(OSError), open(path, errors="replace") as file:
        return file.read(4096).strip()
    return None


def numbers(path: str) -> dict[bytes, int]:
    """Parses the lines ``Name:   123 kB`` (converted to bytes) and ``Name:   123``."""
    values: dict[bytes, int] = {}
    for line in content(path).splitlines():
        words = line.split()
        if len(words) > 1 and words[1].isdigit():
            values[words[0][:-1]] = int(words[1]) * (1024 if words[-1] == b"kB" else 1)
    return values


def process_of(thread: int) -> int:
    """Returns the pid of the process that ``thread`` belongs to; 0 if it has ended."""
    with contextlib.suppress(OSError):
        return numbers(f"/proc/{thread}/status").get(b"Tgid", 0)
    return 0


def descriptors(pid: int) -> int:
    """Returns how many files a process has open; 0 if it has ended or may not be inspected."""
    with contextlib.suppress(OSError):
        return len(os.listdir(f"/proc/{pid}/fd"))
    return 0


def all_children() -> Children:
    """Returns the children of each process on this machine; takes some 0.1 ms per process."""
    children: dict[int, list[int]] = {}
    for pid in pids():
        with contextlib.suppress(OSError):
            children.setdefault(_parent(pid), []).append(pid)
    return children


def descendants(
    root: int, keep: Collection[int] = (), children: Children | None = None
) -> list[int]:
    """Returns the pids below ``root``, without those in ``keep`` and their descendants.
    ``children``: a recent result of ``all_children``; by default a new one.
    """
    children = all_children() if children is None else children
    # A pid that is reused while all_children looks can be both above and below another one.
    seen, pids = {root, *keep}, list[int]()
    pending = [root]
    while pending:
        below = [pid for pid in children.get(pending.pop(), ()) if pid not in seen]
        seen.update(below)
        pids += below
        pending += below
    return pids


def is_below(pid: int, root: int) -> bool:
    """Whether ``root`` is an ancestor of ``pid``; also True if ``pid`` ends meanwhile."""
    try:
        while pid > 1 and pid != root:
            pid = _parent(pid)
    except OSError:
        return True
    return pid == root


def _parent(pid: int) -> int:
    return int(stat(pid)[1])

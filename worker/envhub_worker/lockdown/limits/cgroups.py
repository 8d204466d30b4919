"""Limits of memory and processes by control groups, where this process may make them.

That takes root under cgroup v1 or v2, or a delegated v2 group. The server makes a group for each
jail; a runner joins it before anything else, through descriptors that the server opened. Without
control groups ``watchdog`` measures instead.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from envhub_worker.lockdown.mechanisms.locked_folder import unheld
from envhub_worker.protocol.confinement import Limits
from envhub_worker.protocol.records import dataclass

_MOUNTS = "/proc/self/mountinfo"
_OWN = "/proc/self/cgroup"
_PREFIX = "envhub_"


@dataclass(frozen=True)
class Hierarchy:
    """A hierarchy in which groups for jails can be made.
    ``kind``: ``"cgroup-v1"`` or ``"cgroup-v2"``; ``folders``: one for each controller; v2 has one.
    """

    kind: str
    folders: tuple[str, ...]


def find(mounts: str, own: str, *, root: bool) -> Hierarchy | None:
    """Finds the hierarchy from ``/proc/self/mountinfo`` and ``/proc/self/cgroup``. Pure.
    ``root``: whether we are root, who may make a v2 group at the top, wherever our own group is.
    """
    entries = [line.split(":", 2) for line in own.splitlines()]
    # By controller; the v2 hierarchy has the empty name.
    paths = {name: path for _, names, path in entries for name in names.split(",")}
    points = _mount_points(mounts)
    if root and "memory" in points and "pids" in points:
        folders = [points[name] + paths.get(name, "/") for name in ("memory", "pids")]
        return Hierarchy("cgroup-v1", tuple(folder.rstrip("/") for folder in folders))
    if "" in points:
        own_path = "/" if root else paths.get("", "/")
        return Hierarchy("cgroup-v2", ((points[""] + own_path).rstrip("/"),))
    return None


def _mount_points(mounts: str) -> dict[str, str]:
    points: dict[str, str] = {}
    for line in mounts.splitlines():
        left, _, right = line.partition(" - ")
        kind, _, options = right.split(" ", 2)
        controllers = options.rpartition(" ")[2].split(",") if kind == "cgroup" else [""]
        if kind in ("cgroup", "cgroup2"):
            points |= dict.fromkeys(controllers, left.split()[4])
    return points


def discover() -> Hierarchy | None:
    """Returns the hierarchy of this process if a trial group with limits can be made in it."""
    with open(_MOUNTS) as mounts, open(_OWN) as own:
        hierarchy = find(mounts.read(), own.read(), root=os.geteuid() == 0)
    if hierarchy is None or not all(os.access(path, os.W_OK) for path in hierarchy.folders):
        return None
    return hierarchy


class Tree:
    """The folder that holds the groups of one spawner's jails.

    This process holds a lock on it for life, by which other servers know that it is in use, also
    from other namespaces. Its name tells nothing about the host, for jails can read it.
    """

    def __init__(self, hierarchy: Hierarchy, name: str) -> None:
        """Make the folder ``envhub_<random>_<name>``.
        Raises ``OSError``: the kernel refuses; use the watchdog.
        """
        self._locks: list[int] = []  # one for each folder that we have made
        self.kind = hierarchy.kind
        own = f"{_PREFIX}{secrets.randbits(62)}_{name}"
        self._folders = [f"{folder}/{own}" for folder in hierarchy.folders]
        # In this order. Version 2 passes controllers on only from a group without processes, so
        # ours leave it first. Then the folder is made and locked, before a group in it could be
        # taken for abandoned.
        _remove_abandoned(hierarchy.folders)
        if self.kind == "cgroup-v2":
            _step_aside(hierarchy.folders[0])
            _enable(hierarchy.folders[0])
        try:
            for folder in self._folders:
                self._locks.append(_made_and_locked(folder))
            if self.kind == "cgroup-v2":
                _enable(self._folders[0])
        except OSError:
            self.remove()
            raise

    def group(self, name: str, limits: Limits) -> Group:
        """Makes a group with ``limits``. Raises ``OSError``: the kernel refuses."""
        return Group(self.kind, [f"{folder}/{name}" for folder in self._folders], limits)

    def remove(self) -> None:
        """Remove the folder and every group in it; their processes must have ended."""
        for folder in self._folders[: len(self._locks)]:  # one that we did not make is another's
            _remove_tree(folder)
        # Last: until then no other server may remove the same folder.
        while self._locks:
            os.close(self._locks.pop())


def _made_and_locked(folder: str, *, exist_ok: bool = False) -> int:
    """Create a group and return the descriptor that holds its lock."""
    while True:
        os.makedirs(folder, exist_ok=exist_ok)
        # Another server may find the group before it is locked, and remove it: then try again.
        with contextlib.suppress(FileNotFoundError):
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(lock, fcntl.LOCK_EX)
            if os.path.isdir(folder):
                return lock
            os.close(lock)


def _remove_abandoned(folders: Sequence[str]) -> None:
    """Remove groups of servers that were killed. The kernel keeps those with processes."""
    for folder in folders:
        for name in os.listdir(folder):
            if name.startswith(_PREFIX):
                with contextlib.suppress(OSError), unheld(f"{folder}/{name}"):
                    _remove_tree(f"{folder}/{name}")


def _remove_tree(folder: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        groups = [entry.path for entry in os.scandir(folder) if entry.is_dir()]
        _remove([*groups, folder])


def _step_aside(folder: str) -> None:
    """Move the processes of ``folder`` into a leaf below it.

    A v2 group that holds processes may not limit groups below it, unless it is the top one.
    """
    with open(f"{folder}/cgroup.procs") as file:
        pids = file.read().split()
    if not pids or not os.path.exists(f"{folder}/cgroup.type"):
        return  # the top one has no type
    leaf = f"{folder}/{_PREFIX}{os.getpid()}_leaf"
    lock = _made_and_locked(leaf, exist_ok=True)  # until processes keep it
    try:
        for pid in pids:
            _write(f"{leaf}/cgroup.procs", pid)
    finally:
        os.close(lock)


def _enable(folder: str) -> None:
    with open(f"{folder}/cgroup.subtree_control") as file:
        enabled = file.read().split()
    for controller in ("memory", "pids"):
        if controller not in enabled:
            _write(f"{folder}/cgroup.subtree_control", f"+{controller}")


class Group:
    """The control group of one jail."""

    def __init__(self, kind: str, folders: Sequence[str], limits: Limits) -> None:
        self.kind = kind
        self._folders = list(folders)  # v1: of memory, of pids; v2: one for both
        for folder in folders:
            os.mkdir(folder)
        try:
            for path, text, required in _settings(kind, self._folders, limits):
                with contextlib.suppress(*(() if required else (OSError,))):
                    _write(path, text)
        except OSError:
            self.remove()
            raise

    def open(self) -> list[int]:
        """Descriptors for init: the file that counts out-of-memory, then the files for joining."""
        newer = self.kind == "cgroup-v2"
        name = "memory.events" if newer else "memory.oom_control"
        events = os.open(f"{self._folders[0]}/{name}", os.O_RDONLY | os.O_CLOEXEC)
        # A thread that moves only itself takes no lock that waits for every core: 0.1 ms instead
        # of 12. Version 2 has no file for that between groups like ours.
        file = "cgroup.procs" if newer else "tasks"
        joins = [
            os.open(f"{folder}/{file}", os.O_WRONLY | os.O_CLOEXEC) for folder in self._folders
        ]
        return [events, *joins]

    def refused(self) -> bool:
        """Whether the kernel has refused the jail a process or thread over its limit."""
        with contextlib.suppress(OSError), open(f"{self._folders[-1]}/pids.events") as file:
            return any(line.startswith("max ") and line.split()[1] != "0" for line in file)
        return False

    def remove(self) -> None:
        """Remove the group; its processes must have ended."""
        _remove(self._folders)


def _settings(kind: str, folders: Sequence[str], limits: Limits) -> list[tuple[str, str, bool]]:
    """Yields the group's settings: (file, content, whether the file must exist)."""
    memory, processes = str(limits.memory_bytes), str(limits.processes)
    if kind == "cgroup-v2":
        return [
            (f"{folders[0]}/memory.max", memory, True),
            (f"{folders[0]}/memory.swap.max", "0", False),
            (f"{folders[0]}/memory.oom.group", "1", False),
            (f"{folders[0]}/pids.max", processes, True),
        ]
    return [
        (f"{folders[0]}/memory.limit_in_bytes", memory, True),
        (f"{folders[0]}/memory.memsw.limit_in_bytes", memory, False),
        (f"{folders[1]}/pids.max", processes, True),
    ]


def oom_kills(events: int) -> int:
    """Returns how many processes of the group the kernel has killed for memory."""
    for line in os.pread(events, 4096, 0).splitlines():
        name, _, count = line.partition(b" ")
        if name == b"oom_kill":
            return int(count)
    return 0


def _write(path: str, text: str) -> None:
    with open(path, "w") as file:
        file.write(text)


def _remove(folders: Sequence[str]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            os.rmdir(folder)


_COUNTS = ("memory.events", "memory/memory.oom_control")  # of version 2, and of version 1
OUTER_LIMIT = (
    "the memory limit around the server (its container's) was reached: the kernel ended a process"
)


class SurroundingLimit:
    """The memory limit around the server itself: that of its container, which all jails share.

    It tells whether a process was killed for that limit.
    """

    def __init__(self, root: Path = Path("/sys/fs/cgroup")) -> None:
        self._events = -1
        for name in _COUNTS:
            if self._events < 0:
                with contextlib.suppress(OSError):
                    self._events = os.open(root / name, os.O_RDONLY | os.O_CLOEXEC)
        self._seen = self._count()

    def killed_one(self) -> bool:
        """Whether the kernel has killed a process for this limit since the last call."""
        if self._count() <= self._seen:
            return False
        self._seen += 1  # not the count: each kill explains one death
        return True

    def _count(self) -> int:
        try:
            return oom_kills(self._events) if self._events >= 0 else 0
        except (OSError, ValueError):
            return 0

    def close(self) -> None:
        """Close the descriptor. Idempotent."""
        if self._events >= 0:
            os.close(self._events)
            self._events = -1

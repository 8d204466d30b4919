"""Builds a private, read-only root, and mounts each jail's own file systems over it.

This happens in two steps. The zygote builds the root that its jails share. Then a jail's init hides
all snapshots but its own, mounts its scratch and its proc, and puts overlays over its snapshot and
its packages: the jail may write there, and the shared files do not change. Mount points keep the
host's paths, so a snapshot below ``/tmp`` is no special case.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from envhub_worker.lockdown import root_plan
from envhub_worker.lockdown.mechanisms import kernel, namespaces
from envhub_worker.lockdown.root_plan import (
    HOME,
    SHARED_MEMORY,
    TEMPORARY,
    TERMINALS,
    WORK,
    RootPlan,
    within,
)

_READ_ONLY = kernel.ATTR_RDONLY | kernel.ATTR_NOSUID | kernel.ATTR_NODEV
_PLAIN = kernel.MS_NOSUID | kernel.MS_NODEV
_SCRATCH = "/.scratch"
_SKELETON = "/.skeleton"
_MAX_TERMINALS = 64
"""Pseudo terminals of one jail: each is some 40 KiB of the kernel's memory in no account, and all
users of a host, its own programs apart, have 3,072."""

# Files of /proc about the host that stay visible, since libraries read them. The rest is covered.
_PROC_KEPT = frozenset(
    {
        *("cgroups", "cpuinfo", "devices", "filesystems", "loadavg", "meminfo", "mounts", "net"),
        *("self", "stat", "sys", "sysvipc", "thread-self", "uptime", "version"),
    }
)


# Covered although they lie below a visible folder: they identify the host.
_PROC_COVERED = ("/proc/sys/kernel/random/boot_id",)


def enter_root(plan: RootPlan, root: str, copied: Sequence[str], user: int | None) -> None:
    """Make ``root`` a root with the plan's files and the host's /proc; enter it, detach the old.

    Needs a mount namespace of our own; nothing propagates out of it.

    Args:
        copied: Folders whose files the new root shows as the jails' own, so that overlays can copy
            them.
        user: The user of the jails if it differs from this process's own, else None.
    """
    # Before the first mount, or the host would see ours.
    kernel.mount("none", "/", "none", kernel.MS_REC | kernel.MS_PRIVATE)
    # The trees are cloned before the new root is mounted, which may lie below one of them.
    own = {} if user is None else _take_for(user, root_plan.outermost(copied))
    shown = root_plan.outermost((*plan.trees, *plan.roots))
    trees = _take((path for path in shown if path not in own), _READ_ONLY)
    trees |= _take(plan.devices, kernel.ATTR_NOSUID | kernel.ATTR_NOEXEC)
    # The kernel permits a new proc only where an unmasked one is visible, so keep the old one.
    trees |= _take(("/proc",), 0)
    files = {path: Path(path).read_bytes() for path in plan.copies}
    files |= {path: text.encode() for path, text in plan.texts.items()}
    kernel.mount("sandbox", root, "tmpfs", _PLAIN, "size=4m,nr_inodes=4096,mode=755")
    for path in root_plan.OWN_FOLDERS:
        os.makedirs(root + path, 0o755, exist_ok=True)
    _put(trees | own, root)  # in this order: one of the latter may lie in one of the former
    for path, content in files.items():
        _write(root + path, content)
    for path, target in plan.links.items():
        _link(root + path, target)
    os.chdir(root)
    # With the same folder twice the old root comes to lie on top of the new one, and the unmount
    # takes it away: no folder of the new root must hold it meanwhile.
    kernel.pivot_root(".", ".")
    kernel.unmount(".")
    os.chdir("/")
    # Last: until now mount points were made in it.
    kernel.restrict_mount("/", kernel.ATTR_RDONLY)


def _take(paths: Iterable[str], attributes: int) -> dict[str, int]:
    """Returns a detached copy of the mount tree at each path."""
    trees = {}
    for path in paths:
        trees[path] = kernel.clone_tree(path)
        if attributes:
            kernel.restrict_tree(trees[path], attributes)
    return trees


def _take_for(user: int, paths: Iterable[str]) -> dict[str, int]:
    """Like ``_take``, but root's files belong to ``user``; omits paths that cannot be mapped so."""
    trees: dict[str, int] = {}
    with contextlib.suppress(OSError):
        users = namespaces.mapped_to(user)
        for path in paths:
            trees |= _take([path], _READ_ONLY)
            try:
                kernel.restrict_tree(trees[path], kernel.ATTR_IDMAP, userns=users)
            except OSError:  # this file system cannot
                os.close(trees.pop(path))
        os.close(users)
    return trees


def _put(trees: Mapping[str, int], below: str = "") -> None:
    """Attach each tree at its own path inside the folder ``below``."""
    for path, tree in trees.items():
        target = below + path
        if os.path.isdir(f"/proc/self/fd/{tree}"):
            os.makedirs(target, 0o755, exist_ok=True)
        elif not os.path.exists(target):
            _write(target, b"")
        kernel.attach_tree(tree, target)
        os.close(tree)


def _write(path: str, content: bytes) -> None:
    os.makedirs(os.path.dirname(path), 0o755, exist_ok=True)
    Path(path).write_bytes(content)


def _link(path: str, target: str) -> None:
    os.makedirs(os.path.dirname(path), 0o755, exist_ok=True)
    with contextlib.suppress(OSError):
        # If the parent is a read-only tree of the host, it has the link already.
        os.symlink(target, path)


def mount_proc() -> None:
    """Mount a /proc of our own pid namespace over the present one."""
    kernel.mount("proc", "/proc", "proc", _PLAIN | kernel.MS_NOEXEC)


def proc_to_cover() -> tuple[list[str], list[str]]:
    """Returns the (files, folders) of /proc that a jail does not need but could read."""
    files = list(filter(os.path.exists, _PROC_COVERED))
    folders: list[str] = []
    for name in sorted(os.listdir("/proc")):
        if not name.isdigit() and name not in _PROC_KEPT:  # processes come and go
            path = f"/proc/{name}"
            mode = os.lstat(path).st_mode
            if mode & 0o004:
                (folders if stat.S_ISDIR(mode) else files).append(path)
    return files, folders


def cover_proc(files: Sequence[str], folders: Sequence[str]) -> None:
    """Hide ``files`` and ``folders`` of the mounted /proc under empty files and folders."""
    for path in files:
        _bind("/dev/null", path)
    for path in folders:
        _bind(_SCRATCH, path)


def _bind(source: str, target: str) -> None:
    tree = kernel.clone_tree(source)
    kernel.attach_tree(tree, target)
    os.close(tree)


class View(NamedTuple):
    """The mounts of a jail's snapshot and packages.

    Attributes:
        shared: By path of each copy-on-write mount: descriptor of the shared folder below it.
        refused: By path of each read-only mount: why this host has no overlay for it.
    """

    shared: dict[str, int]
    refused: dict[str, str]


def mount_skeleton(packages: str) -> None:
    """Mirror the folders of ``packages``, owned by the jails' user, for each jail's overlay.

    Without the mirror, folders in an overlay would be read-only or another user's, like the shared
    ones.
    """
    kernel.mount("skeleton", _SKELETON, "tmpfs", _PLAIN, "mode=755")
    _mirror_folders(packages, f"{_SKELETON}/packages")
    # All jails of the zygote mount their overlays over it.
    kernel.restrict_mount(_SKELETON, kernel.ATTR_RDONLY)


def mount_jail(
    snapshot: str,
    packages: str,
    roots: Iterable[str],
    trees: Iterable[str],
    links: Mapping[str, str],
    *,
    size: int,
    inodes: int,
) -> View:
    """Mount everything that belongs to one jail. Needs a mount namespace of its own.

    Args:
        snapshot: The jail's snapshot, shown at this path; the rest below ``roots`` is hidden.
        packages: The jail's folder of packages, which has a skeleton; or empty.
        trees: The trees of the zygote's root (``RootPlan.trees``).
        links: The links of that root, some of which may lead to the interpreter.
    """
    hidden = [*roots, TEMPORARY, SHARED_MEMORY, HOME, WORK]
    buried = [path for path in trees if any(within(path, folder) for folder in hidden)]
    # In this order. What must stay visible is taken first, since the next mounts hide all snapshots
    # and whatever lies below temporary folders. It is put back upon them, with the links. Only then
    # do the empty folders become read-only: the mount points were made in them. The overlays come
    # last; they hold their upper folders, so the scratch itself can go out of sight.
    kept = _take((*buried, snapshot), 0)
    for folder in roots:
        kernel.mount("hidden", folder, "tmpfs", _PLAIN, "size=64k,nr_inodes=64,mode=755")
    _mount_scratch(size, inodes)
    _mount_terminals()
    _put(kept)
    for path, target in links.items():
        if any(within(path, folder) for folder in hidden):
            _link(path, target)
    for folder in roots:
        with contextlib.suppress(OSError):
            kernel.restrict_mount(folder, kernel.ATTR_RDONLY)
    view = _mount_views(snapshot, packages)
    kernel.unmount(_SCRATCH)
    return view


def _mount_scratch(size: int, inodes: int) -> None:
    """Mount one tmpfs, so that home, temporary files and work share one quota."""
    options = f"size={size},nr_inodes={inodes},mode=700"
    kernel.mount("scratch", _SCRATCH, "tmpfs", _PLAIN, options)
    for name, target in (("home", HOME), ("tmp", TEMPORARY), ("shm", SHARED_MEMORY)):
        os.mkdir(f"{_SCRATCH}/{name}", 0o700)
        _bind(f"{_SCRATCH}/{name}", target)
    os.mkdir(f"{TEMPORARY}/runtime", 0o700)


def _mount_terminals() -> None:
    """Mount the jail's own devpts, if the host permits it; no other process sees its terminals."""
    with contextlib.suppress(OSError):
        options = f"newinstance,ptmxmode=666,mode=600,max={_MAX_TERMINALS}"
        flags = kernel.MS_NOSUID | kernel.MS_NOEXEC
        kernel.mount("terminals", TERMINALS, "devpts", flags, options)


def _mount_views(snapshot: str, packages: str) -> View:
    view = View({}, {})
    _mirror_folders(snapshot, f"{_SCRATCH}/snapshot")
    _mount_copy_on_write(snapshot, f"{_SCRATCH}/snapshot", (), view)
    if packages:
        os.mkdir(f"{_SCRATCH}/packages", 0o755)
        _mount_copy_on_write(packages, f"{_SCRATCH}/packages", (f"{_SKELETON}/packages",), view)
        # Covered, not unmounted: an unmount waits some milliseconds for all readers.
        os.mkdir(f"{_SCRATCH}/empty", 0o500)
        _bind(f"{_SCRATCH}/empty", _SKELETON)
    if snapshot in view.shared:
        _bind(snapshot, WORK)
        return view
    # Links into the read-only snapshot, in a folder that takes new files.
    os.mkdir(f"{_SCRATCH}/work", 0o700)
    _bind(f"{_SCRATCH}/work", WORK)
    for name in os.listdir(snapshot):
        os.symlink(f"{snapshot}/{name}", f"{WORK}/{name}")
    return view


def _mount_copy_on_write(path: str, upper: str, skeleton: Sequence[str], view: View) -> None:
    """Mount an overlay on ``path`` with ``upper`` for writes, or record why the host refuses."""
    below = os.open(path, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        mount_overlay(path, (*skeleton, path), upper)
    except OSError as error:
        os.close(below)
        view.refused[path] = f"mounting an overlay answers {error.strerror}"
    else:
        view.shared[path] = below


def mount_overlay(path: str, lower: Sequence[str], upper: str) -> None:
    """Mount the folders ``lower`` over ``path``, the first one on top; writes go to ``upper``.
    Raises ``OSError``: for example, Linux before 5.11 has no overlays in user namespaces.
    """
    inner = f"{upper}-inner"
    os.mkdir(inner, 0o700)
    escaped = str.maketrans({"\\": "\\\\", ":": "\\:", ",": "\\,"})
    folders = ":".join(path.translate(escaped) for path in lower)
    options = f"lowerdir={folders},upperdir={upper},workdir={inner},userxattr"
    kernel.mount("copy-on-write", path, "overlay", _PLAIN, options)


def _mirror_folders(source: str, target: str) -> None:
    """Make the folders of ``source`` again in ``target``, so that they belong to the jail's user.

    It does not recurse, as ``os.walk`` does before Python 3.12: a stranger chose the depth.
    """
    waiting = [""]
    while waiting:
        below = waiting.pop()
        os.mkdir(target + below, 0o755)
        with contextlib.suppress(OSError), os.scandir(source + below) as items:
            folders = (item.name for item in items if item.is_dir(follow_symlinks=False))
            waiting += [f"{below}/{name}" for name in folders]

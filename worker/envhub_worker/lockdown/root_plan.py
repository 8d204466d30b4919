"""The part of the host's file system that a jail sees: a pure plan, which ``mounts`` builds.

Files that this plan does not name do not exist in a jail.
"""

from __future__ import annotations

import os
import posixpath
from collections.abc import Callable, Collection, Iterable

from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.lockdown.mechanisms.namespaces import INSIDE_UID
from envhub_worker.protocol.records import dataclass

HOME = "/sandbox/home"
WORK = "/sandbox/work"
TEMPORARY = "/tmp"
SHARED_MEMORY = "/dev/shm"
TERMINALS = "/dev/pts"

#: Mount points that each jail fills for itself.
OWN_FOLDERS = (
    *(HOME, WORK, TEMPORARY, SHARED_MEMORY, TERMINALS, "/proc", "/.scratch", "/.skeleton"),
)

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32")
_ETC_FOLDERS = ("/etc/alternatives", "/etc/fonts", "/etc/glvnd", "/etc/vulkan", "/etc/OpenCL")
_ETC_FILES = ("/etc/ld.so.cache", "/etc/localtime", "/etc/mime.types", "/etc/os-release")
_NETWORK_FILES = ("/etc/resolv.conf", "/etc/hosts", "/etc/services", "/etc/gai.conf")
_NETWORK_FOLDERS = ("/etc/ssl", "/etc/pki", "/etc/ca-certificates")
_SYS_FOLDERS = ("/sys/devices/system/cpu", "/sys/devices/system/node")
# /dev/zero is missing under every policy: a mapping of it is shared memory that can be hidden from
# init (see the filter). No driver is known to need it.
# /dev/tty is the terminal that a process has got in its jail: the zygote and each runner lead
# sessions of their own, which have none.
_DEVICES = ("/dev/null", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty")

_TEXTS = {
    "/etc/passwd": f"sandbox:x:{INSIDE_UID}:{INSIDE_UID}:sandbox:{HOME}:/bin/sh\n"
    "nobody:x:65534:65534:nobody:/:/bin/false\n",
    "/etc/group": f"sandbox:x:{INSIDE_UID}:\nnogroup:x:65534:\n",
    "/etc/nsswitch.conf": "passwd: files\ngroup: files\nhosts: files dns\n",
    "/etc/hosts": "127.0.0.1 localhost sandbox\n::1 localhost\n",
}
_DEV_LINKS = {
    "/dev/fd": "/proc/self/fd",
    "/dev/ptmx": f"{TERMINALS}/ptmx",
    "/dev/stdin": "/proc/self/fd/0",
    "/dev/stdout": "/proc/self/fd/1",
    "/dev/stderr": "/proc/self/fd/2",
}


@dataclass(frozen=True)
class RootPlan:
    """The content of a new root, in the order in which it is added.

    Attributes:
        trees: Paths that appear at the host's location, read-only, with everything below them.
        roots: Folders with snapshots, which appear likewise; each jail then covers them.
        links: Symbolic links: path to target.
        texts: Files of our own: path to content.
    """

    trees: tuple[str, ...]
    roots: tuple[str, ...]
    devices: tuple[str, ...]
    copies: tuple[str, ...]
    links: dict[str, str]
    texts: dict[str, str]


@dataclass(frozen=True)
class HostFiles:
    """The functions by which the plan reads the host's files.

    Attributes:
        readlink: Returns a symbolic link's target, or None for any other file.
        listdir: Returns the names in a folder; empty without that folder.
        read: Returns the content of a small file; empty without that file.
    """

    exists: Callable[[str], bool]
    readlink: Callable[[str], str | None]
    listdir: Callable[[str], list[str]]
    read: Callable[[str], str]


def plan_root(
    interpreter: Iterable[str],
    readable: Iterable[str],
    roots: Iterable[str],
    *,
    private: Collection[str],
    devices: Iterable[str],
    network: str,
    host: HostFiles,
) -> RootPlan:
    """Plans the root for all jails of one zygote.

    Args:
        interpreter: Paths that the interpreter needs: prefixes, ``sys.path``, this package.
        readable: Paths that the caller grants by name, and paths of /sys that its devices need.
        roots: Folders with snapshots; each jail later sees only its own snapshot.
        private: Folders that must never appear because an interpreter names something above
            them (a ``sys.path`` entry that is somebody's home).
        network: ``"host"`` adds the files that name resolution and TLS read.
    """
    links: dict[str, str] = dict(_DEV_LINKS)
    named = {path: {path, resolve(path, host, {})} for path in interpreter}  # and what it leads to
    shown = [
        path
        for path, both in named.items()
        if not any(within(path, other) for path in private for other in both)
    ]
    trees = [*shown, *readable, *_ETC_FOLDERS, *_SYS_FOLDERS, *_SYSTEM]
    copies = list(_ETC_FILES)
    texts = dict(_TEXTS)
    if network == "host":
        copies += _NETWORK_FILES
        trees += _NETWORK_FOLDERS
        del texts["/etc/hosts"]

    def real(paths: Iterable[str]) -> tuple[str, ...]:
        resolved = [resolve(path, host, links) for path in paths]
        return outermost(path for path in resolved if host.exists(path))

    return RootPlan(
        trees=real(trees),
        roots=real(roots),
        devices=(*_DEVICES, *devices),
        copies=tuple(path for path in copies if host.exists(path)),
        links={path: target for path, target in links.items() if path not in ("/proc", "/")},
        texts=texts,
    )


def outermost(paths: Iterable[str]) -> tuple[str, ...]:
    """Returns ``paths`` in order, without those below another of them."""
    kept: list[str] = []
    for path in sorted(set(paths)):
        if not any(within(path, other) for other in kept):
            kept.append(path)
    return tuple(kept)


def within(path: str, folder: str) -> bool:
    """Whether the normalised ``path`` is ``folder`` or below it."""
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def resolve(path: str, host: HostFiles, links: dict[str, str]) -> str:
    """Returns the real path; adds every symbolic link on the way to ``links``."""
    current, pending = "/", path.strip("/").split("/")
    for _ in range(256):  # more than the kernel's own limit of 40 links can need
        if not pending:
            break
        step = posixpath.normpath(posixpath.join(current, pending.pop(0)))
        target = host.readlink(step)
        if target is None:
            current = step
            continue
        links[step] = target
        pending = target.strip("/").split("/") + pending
        current = "/" if target.startswith("/") else posixpath.dirname(step)
    return current


def _readlink(path: str) -> str | None:
    return os.readlink(path) if os.path.islink(path) else None


def _listdir(path: str) -> list[str]:
    return sorted(os.listdir(path)) if os.path.isdir(path) else []


def _read(path: str) -> str:
    return procfs.text(path) or ""


def real_host() -> HostFiles:
    """This host's files."""
    return HostFiles(exists=os.path.exists, readlink=_readlink, listdir=_listdir, read=_read)

"""What of ours is on this machine, by looking at the system and not at our own bookkeeping.
Everything of a test lies below a temporary folder with a name of its own. It stands in the command
line of the server, and in the environment of everybody below it: as the time zone, the one variable
that everybody inherits and nobody minds."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from pathlib import Path

_MARKER_FILES = ("/dev/shm", "/tmp", "/var/tmp", str(Path.home()))


@dataclass(frozen=True)
class Traces:
    """What is there.

    Attributes:
        processes: (pid, command) of every live process that names the folder.
        zombies: Pids of dead children of those, and of this process, that nobody has reaped.
        files: Everything below the folder, and what the faulty repository leaves elsewhere.
        descriptors: What those processes and this one hold, by kind.
        sockets: Unix sockets below the folder.
        mounts: Mount points below the folder.
        cgroups: Control groups of those processes' servers.
    """

    processes: frozenset[tuple[int, str]] = frozenset()
    zombies: frozenset[int] = frozenset()
    files: frozenset[str] = frozenset()
    descriptors: Counter[tuple[int, str]] = field(default_factory=Counter)
    sockets: frozenset[str] = frozenset()
    mounts: frozenset[str] = frozenset()
    cgroups: frozenset[str] = frozenset()

    @classmethod
    def of(cls, folder: Path) -> Traces:
        """What there is of a test's folder now."""
        processes = frozenset(_processes(str(folder)))
        pids = {os.getpid(), *(pid for pid, _ in processes)}
        return cls(
            processes=processes,
            zombies=frozenset(_zombies(pids)),
            files=frozenset(_files(folder)),
            descriptors=Counter(_descriptors(pids)),
            sockets=frozenset(_sockets(str(folder))),
            mounts=frozenset(_lines("/proc/self/mountinfo", str(folder))),
            cgroups=frozenset(_cgroups()),
        )

    def beyond(self, base: Traces) -> list[str]:
        """What is there that was not there before."""
        found = []
        for name in ("processes", "zombies", "files", "sockets", "mounts", "cgroups"):
            more = getattr(self, name) - getattr(base, name)
            found += [f"{name}: {one}" for one in sorted(more, key=str)]
        more_fds = self.descriptors - base.descriptors
        return found + [f"descriptors: {count} x {key}" for key, count in more_fds.items()]


@contextlib.contextmanager
def temporary_root() -> Iterator[Path]:
    """A short-named folder that all temporary files of ours go to. Sockets' paths are short."""
    before, zone = tempfile.tempdir, os.environ.get("TZ")
    folder = Path(tempfile.mkdtemp(prefix="ehf", dir="/tmp"))
    folder.chmod(0o711)  # jails of an unused uid pass through
    tempfile.tempdir = os.environ["TZ"] = str(folder)
    try:
        yield folder
    finally:
        tempfile.tempdir = before
        os.environ.pop("TZ")
        if zone is not None:
            os.environ["TZ"] = zone
        with contextlib.suppress(OSError):
            folder.rmdir()  # what is left in it has been reported


def _processes(marker: str) -> Iterator[tuple[int, str]]:
    # Python's own, which a test of multiprocessing starts and which stays with this process.
    ours = {os.getpid(), getattr(resource_tracker._resource_tracker, "_pid", None)}
    for pid in _pids():
        command = _read(f"/proc/{pid}/cmdline").replace("\0", " ")
        marked = marker in command or f"TZ={marker}" in _read(f"/proc/{pid}/environ")
        if marked and pid not in ours and _state(pid) not in ("Z", "X", ""):
            yield pid, command[:120]


def _zombies(parents: set[int]) -> Iterator[int]:
    for pid in _pids():
        fields = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()
        if fields and fields[0] == "Z" and int(fields[1]) in parents:
            yield pid


def _pids() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]


def _state(pid: int) -> str:
    return (_read(f"/proc/{pid}/stat").rpartition(")")[2].split() or [""])[0]


def _read(path: str) -> str:
    try:
        with open(path, errors="replace") as file:
            return file.read()
    except OSError:
        return ""


def _files(folder: Path) -> Iterator[str]:
    for top, folders, names in os.walk(folder):
        yield from (os.path.join(top, name) for name in (*folders, *names))
    for place in _MARKER_FILES:
        path = os.path.join(place, "envhub-fault-marker")
        if os.path.exists(path):
            yield path


def _descriptors(pids: set[int]) -> Iterator[tuple[int, str]]:
    for pid in pids:
        with contextlib.suppress(OSError):
            for name in os.listdir(f"/proc/{pid}/fd"):
                with contextlib.suppress(OSError):
                    yield pid, os.readlink(f"/proc/{pid}/fd/{name}").partition(":[")[0]
        for line in _read(f"/proc/{pid}/maps").splitlines():
            if "memfd:envhub" in line:
                yield pid, "a mapped slab"


def _lines(path: str, marker: str) -> list[str]:
    return [line for line in _read(path).splitlines() if marker in line]


def _sockets(marker: str) -> Iterator[str]:
    """Number and path: how many hold one, and its state, change from one moment to the next."""
    for line in _lines("/proc/net/unix", marker):
        yield " ".join(line.split()[6:])


def _cgroups() -> Iterator[str]:
    """Groups that servers below this very process have made, and hold a lock of."""
    for _, path in _descriptors(set(_children())):
        if path.startswith("/sys/fs/cgroup/") and "/envhub_" in path:
            yield from (entry for entry, _, _ in os.walk(path))


def _children() -> list[int]:
    children = _read(f"/proc/self/task/{os.getpid()}/children").split()
    return [int(pid) for pid in children]

"""One client key's files on disk, with a running total of their charge to the quota.

Several servers of one machine may use a folder (``SharedUse``).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import operator
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import takewhile
from pathlib import Path

from envhub_worker.lockdown.mechanisms.scratch import remove_tree
from envhub_worker.protocol.records import dataclass
from envhub_worker.supervisor.records import RefusedError

BLOCK_BYTES = 4096
"""Charged for the smallest file and for each entry of a tree."""
SHARED = "shared"
"""What stands for a client's key, where all clients are one user's."""


@dataclass(frozen=True)
class ListedFile:
    """One file of an offered snapshot."""

    path: str
    size: int
    sha256: bytes
    executable: bool = False


def blob_charge(size: int) -> int:
    """Returns the bytes that a file counts for."""
    return max(size, BLOCK_BYTES)


def tree_charge(paths: Iterable[str]) -> int:
    """Returns the bytes that a tree of links counts for: a block for each entry."""
    entries, before = 0, list[str]()
    for steps in sorted(path.split("/") for path in paths):
        entries += len(steps) - sum(takewhile(bool, map(operator.eq, before, steps)))
        before = steps
    return BLOCK_BYTES * entries


class BlobStore:
    """The files of one key. ``held``: the bytes that they count for."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self._blobs: dict[str, int] = {}
        self._trees: dict[str, int] = {}
        with contextlib.suppress(FileNotFoundError), os.scandir(home / "blobs") as items:
            self._blobs = {item.name: blob_charge(item.stat().st_size) for item in items}
        for tree in (home / "trees").glob("[0-9a-f]*"):
            self._trees[tree.name] = _charge_on_disk(tree)
        self.held = sum(self._blobs.values()) + sum(self._trees.values())

    @property
    def trees(self) -> int:
        """The number of trees."""
        return len(self._trees)

    def blob(self, sha256: bytes) -> Path:
        """Returns the path of a file, which need not exist."""
        return self.home / "blobs" / sha256.hex()

    def tree(self, digest: str) -> Path:
        """Returns the path of a snapshot, which need not exist."""
        return self.home / "trees" / digest

    def has_all(self, digest: str, files: Collection[ListedFile]) -> bool:
        """Whether a snapshot exists with all of its files."""
        return all(_is_there(self.tree(digest) / file.path, file.size) for file in files)

    def set_aside(self, digest: str) -> None:
        """Move a damaged tree away, so that it can be built again.

        It is removed at the next start: a jail may have it open.
        """
        tree = self.tree(digest)
        aside = tempfile.mkdtemp(prefix=".building-", dir=tree.parent)
        os.chmod(tree, 0o755)  # one that cannot be written cannot be moved
        os.rename(tree, aside)
        self.held -= self._trees.pop(digest, 0)

    def take(self, part: Path, sha256: bytes, size: int) -> None:
        """Add a completely uploaded file."""
        part.chmod(0o444)
        blob = self.blob(sha256)
        blob.parent.mkdir(mode=0o700, exist_ok=True)
        os.rename(part, blob)
        self.held += blob_charge(size) - self._blobs.get(blob.name, 0)
        self._blobs[blob.name] = blob_charge(size)

    def unused(self, in_use: Collection[str]) -> list[str]:
        """Returns the digests of the trees that are not in use, the longest unused first."""
        real = os.path.realpath(self.home / "trees")
        used = {os.path.realpath(path) for path in in_use}
        names = [name for name in self._trees if os.path.join(real, name) not in used]
        return [name for _, name in sorted((_modified(self.tree(name)), name) for name in names)]

    def remove(self, digest: str) -> None:
        """Remove a tree."""
        remove_tree(str(self.tree(digest)))
        self.held -= self._trees.pop(digest)

    def remove_unlinked(self, keep: Collection[bytes]) -> None:
        """Remove the files that are in no tree, except these."""
        names = {sha256.hex() for sha256 in keep}
        with contextlib.suppress(FileNotFoundError), os.scandir(self.home / "blobs") as items:
            for item in items:
                if item.name not in names and item.stat().st_nlink == 1:
                    os.unlink(item.path)
                    self.held -= self._blobs.pop(item.name, 0)

    def lay_out(self, digest: str, files: list[ListedFile], copying: Callable[[int], None]) -> None:
        """Build a tree under a temporary name, then rename it: a digest names complete trees only.

        ``copying`` is called with the size of each file that cannot be a link, before it is copied.
        """
        tree = self.tree(digest)
        make_passable(tree.parent)
        building = Path(tempfile.mkdtemp(prefix=".building-", dir=tree.parent))
        try:
            for file in files:
                if self.blob(file.sha256).stat().st_size != file.size:
                    raise RefusedError("LocalProtocolError", f"{file.path!r} has another size")
                _place(self.blob(file.sha256), building / file.path, file.executable, copying)
            for folder, _, _ in os.walk(building, topdown=False):
                if folder != str(building):
                    os.chmod(folder, 0o555)
            try:
                os.rename(building, tree)
            except OSError as error:  # another server that shares the store may be faster
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
            os.chmod(tree, 0o555)  # not before: a folder that cannot be written cannot be moved
        finally:
            if building.exists():
                remove_tree(str(building))
        self._trees[digest] = _charge_on_disk(tree)
        self.held += self._trees[digest]


def _is_there(path: Path, size: int) -> bool:
    with contextlib.suppress(OSError):
        status = path.lstat()
        return stat.S_ISREG(status.st_mode) and status.st_size == size
    return False


def make_passable(folder: Path) -> None:
    """Make a folder that only its owner lists; root's jails pass through to a tree."""
    folder.mkdir(parents=True, exist_ok=True)
    os.chmod(folder, 0o711 if os.getuid() == 0 else 0o700)


def _modified(path: Path) -> float:
    with contextlib.suppress(FileNotFoundError):
        return path.stat().st_mtime
    return 0.0  # somebody has removed it by hand


def _place(blob: Path, target: Path, executable: bool, copying: Callable[[int], None]) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if not executable:  # whose mode is that of the blob
        with contextlib.suppress(OSError):  # more links than the file system allows, or none at all
            os.link(blob, target)
            return
    copying(blob.stat().st_size)
    shutil.copyfile(blob, target)
    target.chmod(0o555 if executable else 0o444)


def _charge_on_disk(tree: Path) -> int:
    charge = 0
    for folder, folders, files in os.walk(tree):
        charge += BLOCK_BYTES * (len(folders) + len(files))
        for name in files:
            status = os.lstat(os.path.join(folder, name))
            charge += status.st_size if status.st_nlink == 1 else 0  # a copy
    return charge


class SharedUse:
    """This server's shared lock on a folder. The kernel releases it when the server ends."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "a")  # noqa: SIM115, it goes with this object

    @contextlib.contextmanager
    def alone(self) -> Iterator[bool]:
        """A context that yields whether no other server uses the folder, and keeps others out.

        False on a file system without locks.
        """
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            alone = True
        except OSError:
            alone = False
        try:
            yield alone
        finally:
            with contextlib.suppress(OSError):  # a try for more may have lost the share
                fcntl.flock(self._file, fcntl.LOCK_SH)

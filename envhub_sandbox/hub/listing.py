"""The files of a snapshot with their digests, and the checks of a listing and of files.

A listing is a stranger's text: its names become paths here and its sizes become bytes on disk, so
both are checked before anything is downloaded. Downloaded bytes are hashed while they are written.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import sys
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import field, fields
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol, TypeVar

from envhub_sandbox.errors import PolicyError, SnapshotError, SnapshotTooLargeError
from envhub_sandbox.hub.grammar import (
    LOCAL_TYPES,
    REPO_TYPES,
    Parts,
    has_control_characters,
    join,
    local_reference,
)
from envhub_sandbox.system.platform import wrong_here
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import is_cached_revision
from envhub_worker.protocol.text import size_text

MAX_NAME_BYTES = 255  # NAME_MAX of every common file system.
MAX_PATH_BYTES = 1024  # Leaves room below PATH_MAX (4096) for the store and for a jail's root.
MAX_DEPTH = 64


@dataclass(frozen=True)
class FileRecord:
    """One file of a snapshot: its path relative to the root, with ``/``, its size and digest.

    The digest is ``"git-sha1:<40 hex>"``, the git blob id, or ``"sha256:<64 hex>"`` for files in
    LFS and files of a local folder. Git and local folders say which files are executable; the Hub
    does not.
    """

    path: str
    size: int
    digest: str
    executable: bool = False


Copier = Callable[[FileRecord, Path], None]
"""Writes the file of a record; raises if the bytes are not those of the record."""


class Repository(NamedTuple):
    """A repository's type and name."""

    repo_type: str
    repo_id: str


class CommitFiles(NamedTuple):
    """The files of a commit at a host, not trusted yet.
    ``listing``: the records of the files, not checked yet.
    ``copier``: downloads files, with a title for errors; returns a function that copies each file
    into the store.
    """

    listing: Iterator[FileRecord]
    copier: Callable[[Sequence[FileRecord], str], Copier]


class RepositoryHost(Protocol):
    """A host of repositories: the Hub, or a git host. Every method raises ``HubFailure``."""

    @property
    def public_endpoint(self) -> str:
        """The host's address without a login."""

    def resolve(self, repo: Repository, revision: str | None) -> str:
        """The full commit that a revision is now."""

    def files(self, repo: Repository, commit: str) -> AbstractContextManager[CommitFiles]:
        """The files of a commit, valid within the context."""


@dataclass(frozen=True)
class Snapshot:
    """A repository's files at one commit: verified, read-only, regular, never imported here.

    Attributes:
        repo_id: ``"owner/name"``; for a local folder, or a local file's folder, its absolute path;
            for git ``"https://host/org/repo"``; for a package ``"name@version#id"``.
        repo_type: ``"model"``, ``"space"``, ``"dataset"``, ``"git"``, ``"pypi"``; ``"local"`` for
            a local folder, ``"file"`` for a local file with what it imports.
        commit: The full commit; for local files and packages ``local-`` or ``pypi-`` with a hash
            of the content.
        path: The entry file, relative to ``root``, for example ``"env.py"``.
        root: The folder that holds the files (0444, programs 0555, in folders 0555) and nothing
            else.
        files: Every file below ``root``, sorted by path.
        revision: The revision in the reference; None if it has none.
        assets: Further repositories that its code may read.
    """

    repo_id: str
    repo_type: str
    commit: str
    path: str
    root: Path
    files: tuple[FileRecord, ...]
    revision: str | None = field(default=None, compare=False)
    assets: tuple[Snapshot, ...] = field(default=(), compare=False)

    @property
    def is_local(self) -> bool:
        """Whether it is a snapshot of a folder or file of this machine."""
        return self.repo_type in LOCAL_TYPES

    @property
    def pinned(self) -> str:
        """The repository at its commit, without an entry file: ``"datasets/org/data@COMMIT"``."""
        return f"{self.name}@{self.commit}"

    @property
    def reference(self) -> str:
        """A reference that means this snapshot on every machine.

        For a package, only its version and a lock determine the content.
        """
        if self.is_local:
            return local_reference(self.repo_type, self.repo_id, self.path)
        if self.repo_type == "pypi":
            return self.name
        return join(Parts(self.repo_id, self.commit, self.path, self.repo_type))

    @property
    def hub_copies(self) -> tuple[tuple[str, str, tuple[str, ...], str], ...]:
        """The repository and assets that a jail finds in its Hub cache: the fields of ``HubCopy``.

        Only repositories of the Hub are in it.
        """
        return tuple(
            (
                f"{snapshot.repo_type}s--{snapshot.repo_id.replace('/', '--')}",
                snapshot.commit,
                _cached_revisions(snapshot),
                "" if snapshot is self else str(snapshot.root),
            )
            for snapshot in (self, *self.assets)
            if snapshot.repo_type in REPO_TYPES
        )

    @property
    def name(self) -> str:
        """The repository's part of a reference; for a local folder its path."""
        is_plain = self.is_local or self.repo_type == "model"
        return self.repo_id if is_plain else join(Parts(self.repo_id, repo_type=self.repo_type))

    @property
    def label(self) -> str:
        """Repository, commit and entry file, for errors."""
        if self.is_local:
            return self.reference
        return f"{self._source}:{self.path}"

    def known_as(self, path: str) -> str | None:
        """The name by which the author knows a file, for tracebacks; None if it does not exist."""
        index = bisect_left(self.files, path, key=attrgetter("path"))
        if index == len(self.files) or self.files[index].path != path:
            return None
        if self.is_local:
            return f'"{self.repo_id.rstrip("/")}/{path}"'
        return f'"{path}" of {self._source}'

    @property
    def _source(self) -> str:
        by_content = self.is_local or self.repo_type == "pypi"
        return self.name if by_content else f"{self.name}@{self.commit[:12]}"


def content_digest(files: tuple[FileRecord, ...]) -> str:
    """A hash of names and contents, used as the commit of files without one."""
    rows = [[file.path, file.size, file.digest, *[True] * file.executable] for file in files]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def _cached_revisions(snapshot: Snapshot) -> tuple[str, ...]:
    """The revisions in a jail's Hub cache: ``main``, and the one in the reference if possible."""
    revision = snapshot.revision or "main"
    # "main" is a file there, so it cannot be a folder as well
    cached = (
        revision != snapshot.commit
        and not revision.startswith("main/")
        and is_cached_revision(revision)
    )
    return tuple(sorted({"main", *([revision] if cached else [])}))


@dataclass(frozen=True, kw_only=True)
class SnapshotLimits:
    """Limits of a repository's files, checked by its listing before the download, then on disk."""

    max_bytes: int = 4 * 2**30
    max_files: int = 20_000
    max_file_bytes: int = 2 * 2**30

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise PolicyError(f"{limit.name} must be a positive int, got {value!r}")


DEFAULT_LIMITS = SnapshotLimits()


_File = TypeVar("_File", bound=Any)  # with a path and a size


def listing_within_limits(
    files: Iterable[_File], limits: SnapshotLimits, title: str
) -> tuple[_File, ...]:
    """The files, sorted by path. Raises ``SnapshotTooLargeError`` as soon as a limit is passed."""
    taken: list[_File] = []
    total = 0
    for file in files:
        taken.append(file)
        total += file.size
        if file.size > limits.max_file_bytes:
            excess = f"the file {file.path!r} has {size_text(file.size)}"
            raise _too_large(title, excess, "max_file_bytes", limits.max_file_bytes)
        if len(taken) > limits.max_files:
            raise _too_large(title, "it has too many files", "max_files", limits.max_files)
        if total > limits.max_bytes:
            raise _too_large(title, "its files are too large", "max_bytes", limits.max_bytes)
    return tuple(sorted(taken, key=attrgetter("path")))


def _too_large(title: str, excess: str, name: str, limit: int) -> SnapshotTooLargeError:
    shown = f" ({size_text(limit)})" if name.endswith("_bytes") else ""
    return SnapshotTooLargeError(
        f"{title}: {excess}, over the limit {name}={limit}{shown}. If you accept the size, "
        "download it once, then make_env uses it: "
        f"envhub_sandbox.hub.snapshot.fetch(HubRef.parse(...), limits=SnapshotLimits({name}=...))"
    )


def check_listing_names(files: Iterable[FileRecord], title: str) -> None:
    """Raise ``SnapshotError`` for a name that leaves the tree, is invalid, or clashes."""
    seen: set[str] = set()
    folders: set[str] = set()
    for file in files:
        wrong = _wrong_with_name(file.path) or ("is listed twice" if file.path in seen else None)
        if wrong is not None:
            raise SnapshotError(f"{title}: refused, because the file {file.path!r} {wrong}")
        seen.add(file.path)
        steps = file.path.split("/")
        folders.update("/".join(steps[:depth]) for depth in range(1, len(steps)))
    for path in sorted(seen & folders):
        raise SnapshotError(f"{title}: refused, because {path!r} is both a file and a folder")


def _wrong_with_name(path: str) -> str | None:
    steps = path.split("/")
    if path.startswith("/"):
        return "has an absolute name"
    if not {"", ".", ".."}.isdisjoint(steps):
        return "has an empty, '.' or '..' step in its name"
    if "\\" in path or has_control_characters(path):
        return "has a backslash or a control character in its name"
    if len(steps) > MAX_DEPTH or len(path.encode()) > MAX_PATH_BYTES:
        return f"has a name over {MAX_PATH_BYTES} bytes or {MAX_DEPTH} folders deep"
    if any(len(step.encode()) > MAX_NAME_BYTES for step in steps):
        return f"has a step over {MAX_NAME_BYTES} bytes in its name"
    return wrong_here(path)


_BLOCK = 1 << 20
GIT_SHA1 = "git-sha1"
SHA256 = "sha256"


class HashMismatch(Exception):
    """The bytes of a file are not the recorded ones; ``found`` describes them."""

    def __init__(self, digest: str) -> None:
        super().__init__(digest)
        self.found = digest


def _start(kind: str, size: int) -> Any:
    if kind == SHA256:
        return hashlib.sha256()
    # A git blob id covers the length, too. Git chose SHA-1; we only follow.
    sha1 = hashlib.sha1(usedforsecurity=False)
    sha1.update(b"blob %d\x00" % size)
    return sha1


def digest_of(source: Path, kind: str, size: int) -> str:
    """The digest of a file that should have ``size`` bytes, for example ``"sha256:..."``."""
    running = _start(kind, size)
    with _open_regular(source) as stream:
        copy_bounded(stream, None, sys.maxsize, running)
    return f"{kind}:{running.hexdigest()}"


def copy_verified(source: Path, target: Path, record: FileRecord) -> None:
    """Copy a file into a new file; raises as ``write_verified``."""
    with _open_regular(source) as stream:
        write_verified(stream, target, record)


def write_verified(stream: IO[bytes], target: Path, record: FileRecord) -> None:
    """Write a new file. Raises ``HashMismatch`` unless its bytes are exactly the recorded ones.

    The bytes are hashed while they are written, so they cannot change in between.
    """
    kind = record.digest.partition(":")[0]
    running = _start(kind, record.size)
    with target.open("xb") as out:
        written = copy_bounded(stream, out, record.size, running)
    if written > record.size:
        raise HashMismatch(f"more than {record.size} bytes")
    digest = f"{kind}:{running.hexdigest()}"
    if written != record.size or digest != record.digest:
        raise HashMismatch(f"{written} bytes with {digest}")


def differing(root: Path, mine: Iterable[FileRecord], theirs: Iterable[FileRecord]) -> list[str]:
    """The paths of files below ``root`` that another listing lacks, or has with other bytes."""
    listed = {record.path: record for record in theirs}
    return [
        file.path
        for file in mine
        if (other := listed.get(file.path)) is None
        or other.size != file.size
        or digest_of(root / file.path, other.digest.partition(":")[0], file.size) != other.digest
    ]


@contextmanager
def _open_regular(path: Path) -> Iterator[IO[bytes]]:
    try:
        # reading a pipe or device of this name could block or never end
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise HashMismatch("not a regular file")
        stream = path.open("rb")
    except OSError as error:
        raise HashMismatch(f"unreadable ({error})") from error
    with stream:
        yield stream


def copy_bounded(source: IO[bytes], target: IO[bytes] | None, most: int, digest: Any = None) -> int:
    """Copy a stream in blocks and hash it; stops after ``most`` + 1 bytes. Returns the number of
    bytes, which is larger than ``most`` if the stream is.
    """
    count = 0
    while count <= most and (block := source.read(min(most + 1 - count, _BLOCK))):
        count += len(block)
        if digest is not None:
            digest.update(block)
        if target is not None:
            target.write(block)
    return count

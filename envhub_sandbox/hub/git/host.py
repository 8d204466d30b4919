"""A host of git, as a host of repositories: what is asked for by a commit is that."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.errors import SnapshotIntegrityError
from envhub_sandbox.hub.git import commits
from envhub_sandbox.hub.hashing import GIT_SHA1, HashMismatch, write_verified
from envhub_sandbox.hub.listing import Copier, FileRecord, Repository
from envhub_sandbox.system.log import SNAPSHOT

_LOOKED_AT = 64 << 10
_SHOWN = 10


@dataclass(frozen=True)
class GitHost:
    """Scheme and host of an address, in front of the repository's name."""

    public_endpoint: str

    def resolve(self, repo: Repository, revision: str | None) -> str:
        """The full commit that a branch or a tag is now; None is ``HEAD``."""
        return commits.resolve(f"{self.public_endpoint}/{repo.repo_id}", revision or "HEAD")

    @contextmanager
    def files(self, repo: Repository, commit: str) -> Iterator[_FetchedFiles]:
        """The files of a commit. Links are files with their text; submodules are left out."""
        with commits.fetched(f"{self.public_endpoint}/{repo.repo_id}", commit) as found:
            title = f"{repo.repo_id}@{commit[:12]}"
            if found.submodules:
                shown = ", ".join(map(repr, found.submodules[:_SHOWN]))
                more = f" and {len(found.submodules) - _SHOWN} more"
                more = more if len(found.submodules) > _SHOWN else ""
                SNAPSHOT.warning("%s: submodules are left out: %s%s", title, shown, more)
            if _has_lfs(found):
                SNAPSHOT.warning("%s: of its files in LFS only the pointers are here", title)
            yield _FetchedFiles(found)


def _has_lfs(found: commits.GitFiles) -> bool:
    """Whether ``.gitattributes`` at its root says so."""
    for blob in found.blobs:
        if blob.path == ".gitattributes":
            with found.open(blob) as stream:
                return b"filter=lfs" in stream.read(_LOOKED_AT)
    return False


@dataclass(frozen=True)
class _FetchedFiles:
    """The files of a commit that was fetched."""

    found: commits.GitFiles

    @property
    def listing(self) -> Iterator[FileRecord]:
        for blob in self.found.blobs:
            yield FileRecord(blob.path, blob.size, f"{GIT_SHA1}:{blob.digest}")

    def copier(self, files: Sequence[FileRecord], title: str) -> Copier:
        blobs = {blob.path: blob for blob in self.found.blobs}

        def copy(record: FileRecord, target: Path) -> None:
            try:
                with self.found.open(blobs[record.path]) as stream:
                    write_verified(stream, target, record)
            except HashMismatch as mismatch:
                raise SnapshotIntegrityError(
                    f"{title}: git returned {mismatch.found} as {record.path!r}, which is "
                    f"{record.digest}. Nothing of it was used; try again, with another git"
                ) from mismatch

        return copy

"""One candidate for a reference, from the store or from the Hub: a repository of one type."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.errors import SnapshotError, SnapshotIntegrityError
from envhub_sandbox.hub import store as store
from envhub_sandbox.hub.client import HubClient, Repository
from envhub_sandbox.hub.failures import HubFailure, Kind
from envhub_sandbox.hub.hashing import Mismatch, copy_verified
from envhub_sandbox.hub.listing import (
    FileRecord,
    Snapshot,
    SnapshotLimits,
    check_names,
    within_limits,
)
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.system.log import SNAPSHOT

_SHOWN_FILES = 20


@dataclass(frozen=True)
class Candidate:
    """A reference read as a repository of one type. Raises ``HubFailure`` and ``SnapshotError``."""

    ref: HubRef
    repo: Repository
    hub: HubClient
    limits: SnapshotLimits

    @property
    def folder(self) -> Path:
        """Where the repository's commits lie in the store."""
        return store.repository_folder(self.hub.public_endpoint, *self.repo)

    def stored(self) -> Snapshot | None:
        """The pinned commit, if it is in the store. No request.

        Raises:
            HalfDeletedError: Parts of it are gone.
        """
        slot = self._slot(self.ref.revision or "")
        files = store.load(slot)
        return None if files is None else self._finished(slot, files)

    def fetched(self) -> Snapshot:
        """The revision as the Hub resolves it now, downloaded unless it is in the store."""
        slot = self._slot(self.resolved())
        files = store.load_whole(slot)
        if files is None:
            self._bring(slot)
            files = store.load(slot)
        if files is None:
            raise SnapshotError(f"{slot.title}: somebody removed it from the store; try again")
        return self._finished(slot, files)

    def resolved(self) -> str:
        """The commit that the revision is at the Hub now."""
        commit = self.hub.resolve(self.repo, self.ref.revision)
        if self.ref.is_pinned and commit != self.ref.revision:
            raise SnapshotIntegrityError(
                f"{self.ref}: {self.hub.public_endpoint} answered with another commit, {commit}, "
                "than the pinned one. Do not trust this endpoint; use another"
            )
        return commit

    def _slot(self, commit: str) -> store.Slot:
        title = f"{'/'.join(self.repo)}@{commit} on {self.hub.public_endpoint}"
        return store.Slot(self.folder, commit, title)

    def _bring(self, slot: store.Slot) -> None:
        listing = self.hub.listing(self.repo, slot.commit)
        files = within_limits(listing, self.limits, slot.title)
        check_names(files, slot.title)
        self._require_entry(files)
        size = sum(file.size for file in files)
        SNAPSHOT.info("%s: downloading %d files, %d bytes", slot.title, len(files), size)
        folder = self.hub.download(self.repo, slot.commit, [file.path for file in files])
        note = {"endpoint": self.hub.public_endpoint, **self.repo._asdict()}
        note["revision"] = None if self.ref.is_pinned else self.ref.revision or "main"
        store.publish(slot, files, self._copier(slot, folder), note)
        SNAPSHOT.info("%s: verified, and in the store", slot.title)

    def _copier(self, slot: store.Slot, folder: Path) -> Callable[[FileRecord, Path], None]:
        def copy(record: FileRecord, target: Path) -> None:
            try:
                copy_verified(folder / record.path, target, record)
            except Mismatch:
                # The Hub cache may hold an edited or half-written file: once more, from the Hub.
                target.unlink(missing_ok=True)
                again = self.hub.download_again(self.repo, slot.commit, record.path)
                self._copy_or_refuse(slot, again, target, record)

        return copy

    def _copy_or_refuse(
        self, slot: store.Slot, source: Path, target: Path, record: FileRecord
    ) -> None:
        try:
            copy_verified(source, target, record)
        except Mismatch as mismatch:
            raise SnapshotIntegrityError(
                f"{slot.title}: the file {record.path!r} came with other content than the "
                f"commit's listing says: {mismatch.found}, not {record.size} bytes with "
                f"{record.digest}. Nothing of it was used. A proxy, a mirror or the Hub cache "
                f"changes files: try another network or endpoint, and remove the bad copy: "
                f"rm '{source}'"
            ) from mismatch

    def _finished(self, slot: store.Slot, files: tuple[FileRecord, ...]) -> Snapshot:
        within_limits(files, self.limits, slot.title)
        self._require_entry(files)
        repo_type, repo_id = self.repo
        return Snapshot(repo_id, repo_type, slot.commit, self.ref.path, slot.tree, files)

    def _require_entry(self, files: tuple[FileRecord, ...]) -> None:
        if all(file.path != self.ref.path for file in files):
            what, advice = missing_entry(self.ref.path, files)
            raise HubFailure(Kind.NO_ENTRY, f"the {self.repo.repo_type} repository {what}", advice)


def missing_entry(path: str, files: tuple[FileRecord, ...]) -> tuple[str, str]:
    """What to say when a repository lacks the entry file: which ``.py`` files there are."""
    names = [file.path for file in files if file.path.endswith(".py")]
    what = f"has no file {path!r}"
    if not names:
        return what, "It has no .py file at all, so it is no environment"
    close = difflib.get_close_matches(path, names, n=1) or names
    shown = ", ".join(repr(name) for name in names[:_SHOWN_FILES])
    more = f" and {len(names) - _SHOWN_FILES} more" if len(names) > _SHOWN_FILES else ""
    return what, f"Name the entry behind a colon, as in ':{close[0]}'; it has {shown}{more}"

"""The store: verified snapshots on disk, keyed by endpoint, type, repository and commit.

::

    <cache>/snapshots/huggingface.co-1f2e3d4c/model--org--repo/<commit>/
        record.json     the verified digests, a stat fingerprint of each file, and whether the host
                        gave it without a login
        tree/           the files, 0444 or 0555, in folders 0555, and nothing else

A snapshot is built in a folder of another name and renamed into place, so a folder with a commit's
name is complete. The record is outside the tree, where the jail never sees it.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import stat
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from envhub_sandbox.errors import SnapshotError, SnapshotIntegrityError
from envhub_sandbox.hub.listing import FileRecord, HashMismatch, digest_of
from envhub_sandbox.system import folders, locks, platform
from envhub_sandbox.system.folders import BUILDING, cache_root, draft, remove_tree, write_whole_file
from envhub_sandbox.system.log import SNAPSHOT
from envhub_sandbox.system.platform import IS_WINDOWS, open_flags
from envhub_worker.protocol.records import dataclass

_FORMAT = 1
_PUBLIC = "public"
_ABANDONED_AFTER_S = 24 * 3600.0
_MAX_NAME = 200
_FILE_MODE = 0o444
_PROGRAM_MODE = _TREE_FOLDER_MODE = 0o555


@dataclass(frozen=True)
class Slot:
    """The place of one snapshot in the store; ``title`` names it in errors."""

    folder: Path
    commit: str
    title: str

    @property
    def home(self) -> Path:
        """The folder of the snapshot, which appears by one rename."""
        return self.folder / self.commit

    @property
    def tree(self) -> Path:
        """The root of the repository's files."""
        return self.home / "tree"

    @property
    def record(self) -> Path:
        """The file with the hashes and fingerprints."""
        return self.home / "record.json"


class StoredCommit(NamedTuple):
    """A commit in the store, the revision by which it was fetched, and the date (UTC)."""

    commit: str
    revision: str | None
    fetched: str


class HalfDeletedError(SnapshotIntegrityError):
    """Files of a snapshot are missing, but none differs; ``publish`` restores it."""


def _fingerprint(status: os.stat_result) -> list[int]:
    """The fields of a file's status that change with its content."""
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def repository_folder(endpoint: str, repo_type: str, repo_id: str) -> Path:
    """The folder of a repository's commits. Names of git may have ``--``, the Hub's cannot."""
    host = re.sub(r"[^A-Za-z0-9.-]", "_", urlsplit(endpoint).netloc.rpartition("@")[2])
    key = hashlib.sha256(endpoint.encode()).hexdigest()[:8]
    name = f"{repo_type}--{repo_id.replace('/', '--')}"
    if re.search("--|-/|/-", repo_id) or len(name) > _MAX_NAME:
        name = f"{name[:_MAX_NAME]}-{hashlib.sha256(repo_id.encode()).hexdigest()[:16]}"
    return cache_root() / "snapshots" / f"{host}-{key}" / name


def folder_of(kind: str) -> Path:
    """The folder of snapshots that are named by their content: of local folders and packages."""
    return cache_root() / "snapshots" / kind


def load(slot: Slot) -> tuple[FileRecord, ...] | None:
    """The files of a stored snapshot, verified; None if it is not in the store.

    Each file's size, times and inode are compared with those recorded when its content was
    verified; if they differ, the file is hashed again. Extra and missing files are noticed.
    Raises ``HalfDeletedError``: some files are missing; ``SnapshotIntegrityError``: the tree
    differs from the record; the text says how to remove it.
    """
    text = _record_of(slot)
    if text is None:
        if not os.path.lexists(slot.home):
            return None
        text = _record_of(slot)  # another process may have published it in between
        if text is None:
            raise _damaged(slot, "its record.json is missing", HalfDeletedError)
    with contextlib.suppress(FileNotFoundError):  # reported below
        _refuse_shared_store(slot.tree)
    document, entries = _read_record(slot, text)
    statuses = dict(_walk(slot, slot.tree, "")) if os.path.lexists(slot.tree) else {}
    recorded = {entry.path for entry in entries}
    # Missing files are checked last. Only they raise ``HalfDeletedError``, after which ``publish``
    # replaces the snapshot silently. An added or edited file must be refused, even if another file
    # was deleted as well.
    if extra := sorted(statuses.keys() - recorded):
        raise _damaged(slot, f"the file {extra[0]!r} is extra")
    changed = [
        entry
        for entry, fingerprint in entries.items()
        if (status := statuses.get(entry.path)) is not None
        and (folders.others_write(status) or _fingerprint(status) != fingerprint)
    ]
    _verify_again(slot, changed)
    if missing := sorted(recorded - statuses.keys()):
        raise _damaged(slot, f"the file {missing[0]!r} is missing", HalfDeletedError)
    if changed:
        with contextlib.suppress(OSError):  # a read-only store hashes the files each time
            _write_record(slot.home, slot.tree, document, entries)
    return tuple(entries)


def endpoint_of(tree: Path) -> str:
    """The endpoint from which a stored repository was downloaded, without a login. Raises
    ``OSError``, ``ValueError`` or ``LookupError`` if it is not known.
    """
    return str(_record_beside(tree)["endpoint"])


def programs_of(tree: Path) -> frozenset[str] | None:
    """The executable files of a snapshot, as its host named them, since disks of Windows keep no
    such mode; None of a folder outside the store.
    """
    try:
        return frozenset(_record_beside(tree).get("programs", ()))
    except FileNotFoundError:
        return None


def _record_beside(tree: Path) -> dict[str, Any]:
    # beside another folder a file of this name is a stranger's
    if cache_root() / "snapshots" not in tree.parents:
        raise FileNotFoundError(f"{tree} is not in the store")
    record: dict[str, Any] = json.loads((tree.parent / "record.json").read_bytes())
    return record


def is_public(slot: Slot) -> bool:
    """Whether the host gave a stored snapshot without a login once."""
    text = _record_of(slot)
    return text is not None and _read_record(slot, text)[0].get(_PUBLIC) is True


def mark_public(slot: Slot) -> None:
    """Note that the host gives a stored snapshot without a login."""
    if (text := _record_of(slot)) is not None:
        # the fingerprints stay: files that have changed meanwhile were not verified
        document = {**_read_record(slot, text)[0], _PUBLIC: True}
        with contextlib.suppress(OSError):  # a read-only store asks the host again
            write_whole_file(slot.record, json.dumps(document).encode())


def load_whole(slot: Slot) -> tuple[FileRecord, ...] | None:
    """``load``, but None also if files are missing, for a caller who can ``publish`` it again."""
    try:
        return load(slot)
    except HalfDeletedError:
        return None


def _record_of(slot: Slot) -> bytes | None:
    try:
        _refuse_shared_store(slot.record)
        return slot.record.read_bytes()
    except FileNotFoundError:
        return None


def _read_record(slot: Slot, text: bytes) -> tuple[dict[str, object], dict[FileRecord, list[int]]]:
    try:
        document = json.loads(text)
        if document["format"] != _FORMAT:
            raise ValueError(f"unknown format {document['format']!r}")
        rows, programs = document["files"], frozenset(document.get("programs", ()))
        return document, {
            FileRecord(path, size, digest, path in programs): [size, *times]
            for path, size, digest, *times in rows
        }
    except (ValueError, KeyError, TypeError) as error:
        raise _damaged(slot, f"its record.json cannot be read ({error})") from error


def _walk(slot: Slot, folder: Path | str, prefix: str) -> Iterator[tuple[str, os.stat_result]]:
    try:
        listing = os.scandir(folder)
    except OSError as error:
        raise _damaged(slot, f"its folder {prefix or '.'!r} cannot be read ({error})") from error
    with listing:
        for item in listing:
            status = os.lstat(item.path)  # not item.stat(), which has no inode on Windows
            if not folders.is_trusted(status.st_uid):
                raise _damaged(slot, f"{prefix + item.name!r} belongs to uid {status.st_uid}")
            if stat.S_ISDIR(status.st_mode):
                if folders.others_write(status):
                    raise _damaged(slot, f"others can write in {prefix + item.name!r}")
                yield from _walk(slot, item.path, f"{prefix}{item.name}/")
            elif stat.S_ISREG(status.st_mode):
                yield prefix + item.name, status
            else:
                raise _damaged(slot, f"{prefix + item.name!r} is not a regular file")


def _verify_again(slot: Slot, changed: list[FileRecord]) -> None:
    for entry in changed:
        path = slot.tree / entry.path
        try:
            digest = digest_of(path, entry.digest.partition(":")[0], entry.size)
        except (OSError, HashMismatch) as error:
            raise _damaged(slot, f"the file {entry.path!r} cannot be read ({error})") from error
        if digest != entry.digest or path.lstat().st_size != entry.size:
            raise _damaged(
                slot, f"the file {entry.path!r} was changed: {digest}, not {entry.digest}"
            )
        with contextlib.suppress(OSError):
            path.chmod(_mode_of(entry))


def _damaged(
    slot: Slot, damage: str, kind: type[SnapshotIntegrityError] = SnapshotIntegrityError
) -> SnapshotIntegrityError:
    return kind(
        f"{slot.title}: the copy in the store is not what was verified: {damage}. Nothing of it "
        "was used. Remove it; the next use downloads it again: "
        f"chmod -R u+w '{slot.home}' && rm -r '{slot.home}'"
    )


def publish(
    slot: Slot,
    files: tuple[FileRecord, ...],
    copy: Callable[[FileRecord, Path], None],
    note: Mapping[str, object],
) -> None:
    """Write the files and rename them into place. A complete snapshot that exists already stays.

    ``copy(record, target)`` writes the target, and must raise if the bytes are not the recorded
    ones. ``note`` is kept in the record and says where the snapshot is from. After a failure
    nothing stays.
    """
    refuse_clashes(slot, files)
    # The order matters: the files are written into a draft, then the record, and one rename makes
    # the snapshot. A process that is killed before the rename leaves only a draft, which is
    # removed after a day and never taken for a snapshot.
    try:
        folders.make(slot.folder)
        _refuse_shared_store(slot.folder)
        for abandoned in _older(slot.folder.glob(f"{BUILDING}*"), _ABANDONED_AFTER_S):
            remove_tree(abandoned)
        with draft(slot.folder) as building:
            tree = building / "tree"
            _fill(tree, files, copy)
            fetched = time.strftime("%FT%TZ", time.gmtime())
            document = {"format": _FORMAT, **note, "fetched": fetched}
            _write_record(building, tree, document, files)
            building.chmod(folders.SHARED_MODE)
            with _opened(slot.folder) as handle:
                # one process at a time, or one could move away what another has just published
                with contextlib.suppress(OSError):  # not every file system has locks
                    locks.lock(handle, wait=True)
                _move_remains(slot)
                try:
                    os.rename(building, slot.home)
                except OSError as error:
                    if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                        raise  # otherwise another process was faster
    except OSError as error:
        raise _unwritable(slot, error) from error


def refuse_clashes(slot: Slot, files: Iterable[FileRecord]) -> None:
    """Refuse files whose names the store's file system cannot keep apart, such as by their case.
    Raises ``SnapshotError``, with their names and what to do.
    """
    clash = platform.taken_as_one(file.path for file in files)
    if clash is None:
        return
    try:
        folders.make(slot.folder)
        is_one = platform.ignores_case(slot.folder)
    except OSError as error:
        raise _unwritable(slot, error) from error
    if is_one:
        raise SnapshotError(
            f"{slot.title}: refused, because {clash[0]!r} and {clash[1]!r} are the same file in "
            f"{cache_root()}, whose file system ignores case. Set ENVHUB_CACHE to a folder on one "
            "that does not, such as a volume with case-sensitive APFS on macOS"
        )


def _unwritable(slot: Slot, error: OSError) -> SnapshotError:
    return SnapshotError(
        f"the snapshot store {slot.folder} cannot be written: {error}. Free space or fix its "
        "permissions, or set ENVHUB_CACHE to another folder"
    )


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[int]:
    if IS_WINDOWS:  # Windows cannot open a folder, so it cannot lock one
        yield -1
        return
    handle = os.open(folder, os.O_RDONLY | open_flags("O_DIRECTORY", "O_CLOEXEC"))
    try:
        yield handle
    finally:
        os.close(handle)


def _move_remains(slot: Slot) -> None:
    """Move a half deleted snapshot aside. Jails that use it keep its files: it is removed a day
    later, like an abandoned draft.
    """
    try:
        load(slot)
    except HalfDeletedError as error:
        SNAPSHOT.warning("%s. It has been made again", str(error).partition(". Nothing of it")[0])
        aside = tempfile.mkdtemp(prefix=BUILDING, dir=slot.folder)
        os.rename(slot.home, os.path.join(aside, "remains"))
        os.utime(aside)


def remove(home: Path) -> dict[int, str]:
    """Remove a snapshot unless processes use it (share a lock of its folder); returns these."""
    with contextlib.suppress(FileNotFoundError), _opened(home) as handle:
        try:
            if handle >= 0:
                locks.lock(handle)
            remove_tree(home)
        except BlockingIOError:
            return locks.sharers(home) or {0: "that is not seen from here"}
    return {}


def remove_unused(folder: Path, days: float) -> None:
    """Remove snapshots that were not used for so many days (see ``mark_used``)."""
    for record in _older(folder.glob("*/record.json"), days * 24 * 3600):
        with contextlib.suppress(OSError):
            remove(record.parent)


def _older(paths: Iterable[Path], seconds: float) -> Iterator[Path]:
    for path in paths:
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < time.time() - seconds:
                yield path


def mark_used(slot: Slot) -> None:
    """Note that a snapshot is used now."""
    with contextlib.suppress(OSError):
        os.utime(slot.record)


def _refuse_shared_store(store: Path) -> None:
    """Raise if another user can write there, and so could forge a tree with its record."""
    root = cache_root()
    try:
        why = folders.why_distrusted(store, root)
    except (NotADirectoryError, PermissionError) as error:
        raise SnapshotError(
            f"the snapshot store {root} cannot be read: {error}. Fix it, or set ENVHUB_CACHE to "
            "another folder"
        ) from error
    if why:
        raise SnapshotError(
            f"the snapshot store {root} is not trusted, because other users can change it: {why}; "
            "or set ENVHUB_CACHE to a folder of your own"
        )


def _mode_of(file: FileRecord) -> int:
    return _PROGRAM_MODE if file.executable else _FILE_MODE


def _fill(
    tree: Path, files: tuple[FileRecord, ...], copy: Callable[[FileRecord, Path], None]
) -> None:
    folders_made = {tree}
    folders.make(tree)
    for file in files:
        target = tree / file.path
        if target.parent not in folders_made:
            folders.make(target.parent)
            folders_made.update(p for p in target.parents if tree in p.parents)
        copy(file, target)
        target.chmod(_mode_of(file))
    for folder in folders_made:
        folder.chmod(_TREE_FOLDER_MODE)


def _write_record(
    home: Path, tree: Path, document: Mapping[str, object], files: Collection[FileRecord]
) -> None:
    rows = [
        [file.path, file.size, file.digest, *_fingerprint((tree / file.path).lstat())[1:]]
        for file in files
    ]
    programs = [file.path for file in files if file.executable]
    record = {**document, "files": rows, "programs": programs}
    write_whole_file(home / "record.json", json.dumps(record).encode())


def commits(folder: Path) -> list[StoredCommit]:
    """The commits of a repository in the store, the last fetched first. Verifies nothing."""
    commits = []
    for record in folder.glob("[!.]*/record.json"):
        with contextlib.suppress(OSError, ValueError):
            document = json.loads(record.read_bytes())
            revision, fetched = document.get("revision"), document.get("fetched", "")
            commits.append(StoredCommit(record.parent.name, revision, str(fetched)))
    return sorted(commits, key=attrgetter("fetched"), reverse=True)

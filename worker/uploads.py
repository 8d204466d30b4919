"""Snapshots that clients bring along, by content.

::

    <folder>/<key>/blobs/<sha256>       files, 0444, hashed when they arrived
    <folder>/<key>/trees/<digest>/      snapshots: hard links to them, in folders 0555

Each client key has a store of its own: whoever could name another's hashes would otherwise see
its files. A snapshot is named by the digest of its listing, so the same listing is the same tree.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from envhub_worker.lockdown.scratch import remove_tree
from envhub_worker.protocol import messages as m
from envhub_worker.quotas import Quotas, RefusedError

MAX_PIECE_BYTES = 8 << 20
"""One ``PutBlob``: the server writes and hashes it while everybody else waits."""
MAX_PARTIAL = 64
"""Files of one client under way at once."""
PREFIX = "sha256:"
_SHA256_BYTES = 32
_MAX_DEPTH = 64
_MAX_PATH_BYTES = 4096
_MAX_NAME_BYTES = 255


@dataclass(frozen=True)
class Listed:
    """One file of an offered snapshot."""

    path: str
    size: int
    sha256: bytes


@dataclass
class Partial:
    """A file that is on its way."""

    path: Path
    size: int
    written: int = 0
    running: Any = field(default_factory=hashlib.sha256)


class Uploads:
    """The snapshots of all clients.

    Args:
        folder: Where they lie.
        quotas: How much of them each client may have.
    """

    def __init__(self, folder: Path, quotas: Quotas) -> None:
        self.folder = folder
        self._quotas = quotas
        self._expected: dict[bytes, dict[bytes, int]] = {}
        self._partial: dict[tuple[bytes, bytes], Partial] = {}
        folder.mkdir(parents=True, exist_ok=True)
        for left in [*folder.glob("*/parts"), *folder.glob("*/trees/.building-*")]:
            remove_tree(str(left))

    def offer(
        self, owner: bytes, key: bytes, request: m.OfferSnapshot, in_use: Collection[str]
    ) -> m.Wanted:
        """What is missing of a snapshot. Nothing: it lies ready.

        Args:
            owner: The client's session.
            key: The client's key.
            request: The listing.
            in_use: Trees that must stay, by path.

        Raises:
            RefusedError: A listing that breaks a rule or the quota.
        """
        files = checked_listing(request.files, self._quotas)
        digest = digest_of(files)
        home = self._home(key)
        tree = home / "trees" / digest
        if tree.is_dir():
            os.utime(tree)
            return m.Wanted(PREFIX + digest, ())
        sizes = {file.sha256: file.size for file in files}
        missing = {sha: size for sha, size in sizes.items() if not (_blob(home, sha)).exists()}
        if missing:
            self._make_room(home, sum(sizes.values()), set(sizes), in_use)
            self._expected[owner] = missing
            return m.Wanted(PREFIX + digest, tuple(missing))
        self._expected.pop(owner, None)
        _lay_out(home, tree, files)
        return m.Wanted(PREFIX + digest, ())

    def put(self, owner: bytes, key: bytes, request: m.PutBlob, data: bytes) -> None:
        """Take a piece of a wanted file; the last one makes it a blob.

        Raises:
            RefusedError: Nobody wanted it, it is out of order, or it is not what its hash says.
        """
        size = self._expected.get(owner, {}).get(request.sha256)
        home = self._home(key)
        if size is None:
            if _blob(home, request.sha256).exists():
                return  # another process of the same client was faster
            raise RefusedError("LocalProtocolError", "this file was not asked for")
        partial = self._begin(owner, home, request, size)
        if request.offset != partial.written or len(data) > MAX_PIECE_BYTES:
            self._give_up(owner, request.sha256)
            raise RefusedError("LocalProtocolError", "a piece is out of order, or too large")
        if partial.written + len(data) > size:
            self._give_up(owner, request.sha256)
            raise RefusedError("LocalProtocolError", "a file is larger than it was said to be")
        with partial.path.open("ab") as file:
            file.write(data)
        partial.running.update(data)
        partial.written += len(data)
        if partial.written == size:
            self._finish(owner, home, request.sha256)

    def _begin(self, owner: bytes, home: Path, request: m.PutBlob, size: int) -> Partial:
        place = (owner, request.sha256)
        partial = self._partial.get(place)
        if partial is None or request.offset == 0:
            mine = sum(1 for known, _ in self._partial if known == owner)
            if partial is None and mine >= MAX_PARTIAL:
                raise RefusedError("WorkerError", f"{MAX_PARTIAL} files are on their way already")
            (home / "parts").mkdir(parents=True, exist_ok=True)
            name = hashlib.sha256(owner + request.sha256).hexdigest()
            partial = self._partial[place] = Partial(home / "parts" / name, size)
            partial.path.write_bytes(b"")
        return partial

    def _finish(self, owner: bytes, home: Path, sha256: bytes) -> None:
        partial = self._partial.pop((owner, sha256))
        if partial.running.digest() != sha256:
            partial.path.unlink()
            raise RefusedError("SnapshotIntegrityError", "a file arrived with another hash")
        partial.path.chmod(0o444)
        (home / "blobs").mkdir(exist_ok=True)
        os.rename(partial.path, _blob(home, sha256))
        self._expected[owner].pop(sha256, None)

    def _give_up(self, owner: bytes, sha256: bytes) -> None:
        partial = self._partial.pop((owner, sha256), None)
        if partial is not None:
            partial.path.unlink(missing_ok=True)

    def forget(self, owner: bytes) -> None:
        """A client has gone: what it had begun is removed."""
        self._expected.pop(owner, None)
        for known, sha256 in [place for place in self._partial if place[0] == owner]:
            self._give_up(known, sha256)

    def tree(self, key: bytes, snapshot: str) -> str:
        """The path of a client's snapshot.

        Raises:
            RefusedError: It is not here; a path is none.
        """
        digest = snapshot.removeprefix(PREFIX)
        tree = self._home(key) / "trees" / digest
        if not snapshot.startswith(PREFIX) or not _is_digest(digest) or not tree.is_dir():
            raise RefusedError("WorkerError", "this server has no such snapshot; offer it first")
        return str(tree)

    def used_bytes(self, key: bytes) -> int:
        """What a client's files take."""
        return _size_of(self._home(key))

    def _home(self, key: bytes) -> Path:
        return self.folder / (key.hex()[:32] or "local")

    def _make_room(
        self, home: Path, more: int, needed: Collection[bytes], in_use: Collection[str]
    ) -> None:
        """Remove the longest unused snapshots until the offered one fits, whole."""
        quota = self._quotas.upload_bytes
        trees = [tree for tree in (home / "trees").glob("[0-9a-f]*") if str(tree) not in in_use]
        trees.sort(key=lambda tree: tree.stat().st_mtime)
        keep = {sha.hex() for sha in needed}
        if _size_of(home, leave=keep) + more > quota:
            _remove_unlinked(home, keep)
        while _size_of(home, leave=keep) + more > quota and trees:
            remove_tree(str(trees.pop(0)))
            _remove_unlinked(home, keep)
        if _size_of(home, leave=keep) + more > quota:
            raise RefusedError(
                "WorkerError",
                f"your key's snapshots would take more than the server's quota of {quota} bytes "
                "(--max-upload), and open environments use the others",
            )


def _blob(home: Path, sha256: bytes) -> Path:
    return home / "blobs" / sha256.hex()


def _size_of(home: Path, leave: Collection[str] = ()) -> int:
    total = 0
    for folder in ("blobs", "parts"):
        with contextlib.suppress(FileNotFoundError), os.scandir(home / folder) as items:
            total += sum(item.stat().st_size for item in items if item.name not in leave)
    return total


def _remove_unlinked(home: Path, keep: Collection[str]) -> None:
    with contextlib.suppress(FileNotFoundError), os.scandir(home / "blobs") as items:
        for item in items:
            if item.stat().st_nlink == 1 and item.name not in keep:
                os.unlink(item.path)


def checked_listing(files: tuple[object, ...], quotas: Quotas) -> list[Listed]:
    """A listing whose every entry keeps the rules, sorted by path.

    Trust: input from a client: names become paths of this machine.

    Raises:
        RefusedError: The text says which rule.
    """
    if not 1 <= len(files) <= quotas.upload_files:
        raise RefusedError(
            "WorkerError",
            f"a snapshot has 1 to {quotas.upload_files} files here (--max-upload-files), this one "
            f"has {len(files)}",
        )
    listed = sorted((_listed(file) for file in files), key=lambda file: file.path)
    total = sum(file.size for file in listed)
    if total > quotas.upload_bytes:
        raise RefusedError(
            "WorkerError",
            f"a snapshot of {total} bytes is over the server's quota of {quotas.upload_bytes} "
            "(--max-upload)",
        )
    _check_tree([file.path for file in listed])
    return listed


def _listed(file: object) -> Listed:
    if type(file) is not tuple or [type(part) for part in file] != [str, int, bytes]:
        raise RefusedError("LocalProtocolError", "a file is (path, size, sha256)")
    path, size, sha256 = file
    if size < 0 or len(sha256) != _SHA256_BYTES:
        raise RefusedError("LocalProtocolError", "a file is (path, size, sha256)")
    wrong = wrong_with_path(path)
    if wrong:
        raise RefusedError("LocalProtocolError", f"the file {path[:200]!r} {wrong}")
    return Listed(path, size, sha256)


def wrong_with_path(path: str) -> str:
    """What forbids a relative path, or nothing."""
    steps = path.split("/")
    if path.startswith("/"):
        return "has an absolute name"
    if not {"", ".", ".."}.isdisjoint(steps):
        return "has an empty, '.' or '..' step in its name"
    if "\\" in path or any(character < " " or character == "\x7f" for character in path):
        return "has a backslash or a control character in its name"
    try:
        sizes = [len(step.encode()) for step in steps]
    except UnicodeEncodeError:
        return "has a name that is not UTF-8"
    if len(steps) > _MAX_DEPTH or sum(sizes) + len(steps) > _MAX_PATH_BYTES:
        return "is too deep, or its name too long"
    return "has a step in its name that is too long" if max(sizes) > _MAX_NAME_BYTES else ""


def _check_tree(paths: list[str]) -> None:
    seen = set(paths)
    if len(seen) != len(paths):
        raise RefusedError("LocalProtocolError", "a file is listed twice")
    for path in paths:
        steps = path.split("/")
        for depth in range(1, len(steps)):
            above = "/".join(steps[:depth])
            if above in seen:
                raise RefusedError(
                    "LocalProtocolError", f"{above[:200]!r} is both a file and a folder"
                )


def digest_of(files: list[Listed]) -> str:
    """The name of a snapshot: a hash of its sorted listing."""
    rows = [[file.path, file.size, file.sha256.hex()] for file in files]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def _is_digest(text: str) -> bool:
    return len(text) == 2 * _SHA256_BYTES and all(c in "0123456789abcdef" for c in text)


def _lay_out(home: Path, tree: Path, files: list[Listed]) -> None:
    """Build the tree beside its place and rename it: what bears a digest is complete."""
    (home / "trees").mkdir(exist_ok=True)
    building = Path(tempfile.mkdtemp(prefix=".building-", dir=home / "trees"))
    try:
        for file in files:
            if _blob(home, file.sha256).stat().st_size != file.size:
                raise RefusedError("LocalProtocolError", f"{file.path!r} has another size")
            _place(_blob(home, file.sha256), building / file.path)
        for folder, _, _ in os.walk(building, topdown=False):
            if folder != str(building):
                os.chmod(folder, 0o555)
        os.rename(building, tree)
        os.chmod(tree, 0o555)  # not before: a folder that cannot be written cannot be moved
    finally:
        if building.exists():
            remove_tree(str(building))


def _place(blob: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(blob, target)
    except OSError:  # more links than the file system allows, or none at all
        shutil.copyfile(blob, target)
        target.chmod(0o444)

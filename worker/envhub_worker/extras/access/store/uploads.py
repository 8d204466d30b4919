"""Uploads of snapshots: checks the listing, receives files in pieces, makes a tree of them.

::

    <folder>/<key>/blobs/<sha256>       files, 0444, hashed when they arrived
    <folder>/<key>/trees/<digest>/      snapshots: hard links to them, in folders 0555

Each client key has a store of its own: otherwise a client that knows the hashes of another client's
files could read them. The name of a snapshot is the digest of its listing, so equal listings have
one tree.

Servers of this machine may share a store if all their clients belong to one user: then each client
can use all uploads, and only a server without others removes files.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.extras.access.store.blob_store import (
    SHARED,
    BlobStore,
    ListedFile,
    SharedUse,
    blob_charge,
    make_passable,
    tree_charge,
)
from envhub_worker.lockdown.mechanisms.scratch import remove_tree
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.text import size_text
from envhub_worker.supervisor.records import RefusedError

MAX_PIECE_BYTES = 8 << 20
"""One ``PutBlob``: the server writes and hashes it while everybody else waits."""
MAX_PARTIAL = 64
"""Files of one client under way at once."""
MAX_TREES = 1000
"""Snapshots of one key, those that it is bringing included."""
MAX_STEPS = 200_000
"""Names in all paths of one snapshot."""
PREFIX = "sha256:"
_SNAPSHOT = re.compile(r"sha256:[0-9a-f]{64}")
_SHA256_BYTES = 32
_MAX_DEPTH = 64
_MAX_PATH_BYTES = 4096
_MAX_NAME_BYTES = 255


@dataclass
class Partial:
    """A partly uploaded file."""

    path: Path
    size: int
    written: int = 0
    running: Any = field(default_factory=hashlib.sha256)


@dataclass
class Offer:
    """A snapshot that a session is about to upload.

    Attributes:
        needed: The hashes of all its files, which stay until its tree is laid out.
        missing: The hashes among them that are not uploaded yet, with sizes.
        reserved: Bytes reserved for it in the quota.
    """

    store: BlobStore
    needed: Collection[bytes]
    missing: dict[bytes, int]
    reserved: int


class Uploads:
    """The snapshots of all clients.
    ``shared``: other servers of this machine use the folder, too, and all clients are one user's.
    """

    def __init__(self, folder: Path, quotas: Quotas, *, shared: bool = False) -> None:
        self.folder = folder
        self._quotas = quotas
        self._offers: dict[bytes, Offer] = {}
        self._partial: dict[tuple[bytes, bytes], Partial] = {}
        make_passable(folder)
        self._use = SharedUse(folder / "in-use") if shared else None
        with self._alone() as alone:
            if alone:
                for left in [*folder.glob("*/parts"), *folder.glob("*/trees/.building-*")]:
                    remove_tree(str(left))
        # Counted now, at the start: later all clients would wait for it.
        self._stores = {home.name: BlobStore(home) for home in folder.iterdir() if home.is_dir()}

    def offer(
        self, owner: bytes, key: bytes, request: m.OfferSnapshot, in_use: Collection[str]
    ) -> m.MissingBlobs:
        """Returns the missing hashes of a snapshot; none if it is complete.
        ``in_use``: trees that must stay, by path.
        Raises ``RefusedError``: a listing that breaks a rule or the quota.
        """
        files = checked_listing(request.files, self._quotas)
        digest = digest_of(files)
        store = self._store(key)
        self.forget(owner)  # it begins again
        if store.tree(digest).is_dir():
            if store.has_all(digest, files):
                os.utime(store.tree(digest))
                return m.MissingBlobs(PREFIX + digest, ())
            store.set_aside(digest)
        sizes = {file.sha256: file.size for file in files}
        missing = {sha: size for sha, size in sizes.items() if not store.blob(sha).exists()}
        reserved = tree_charge(file.path for file in files)
        reserved += sum(map(blob_charge, missing.values()))
        self._offers[owner] = Offer(store, sizes.keys(), missing, reserved)
        try:
            self._make_room(store, in_use)
            if not missing:
                self._lay_out(owner, digest, files, in_use)
        except BaseException:
            self.forget(owner)
            raise
        return m.MissingBlobs(PREFIX + digest, tuple(missing))

    def _lay_out(
        self, owner: bytes, digest: str, files: list[ListedFile], in_use: Collection[str]
    ) -> None:
        offer = self._offers[owner]

        def copying(size: int) -> None:
            offer.reserved += size
            self._make_room(offer.store, in_use)

        offer.store.lay_out(digest, files, copying)
        self.forget(owner)

    def put(self, owner: bytes, key: bytes, request: m.PutBlob, data: bytes) -> None:
        """Take a piece of a wanted file; the last one makes it a blob. Raises ``RefusedError``."""
        if len(request.sha256) != _SHA256_BYTES:  # it would be a file's name
            raise RefusedError("LocalProtocolError", "a hash does not have 32 bytes")
        offer = self._offers.get(owner)
        size = None if offer is None else offer.missing.get(request.sha256)
        if offer is None or size is None:
            if self._store(key).blob(request.sha256).exists():
                return  # another process of the same client was faster
            raise RefusedError("LocalProtocolError", "this file was not asked for")
        partial = self._begin(owner, offer.store.home, request, size)
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
            self._finish(owner, offer, request.sha256)

    def _begin(self, owner: bytes, home: Path, request: m.PutBlob, size: int) -> Partial:
        partial = self._partial.get((owner, request.sha256))
        if partial is None or request.offset == 0:
            mine = sum(bringer == owner for bringer, _ in self._partial)
            if partial is None and mine >= MAX_PARTIAL:
                raise RefusedError("WorkerError", f"{MAX_PARTIAL} files are being uploaded already")
            make_passable(home)
            (home / "parts").mkdir(mode=0o700, exist_ok=True)
            name = hashlib.sha256(owner + request.sha256).hexdigest()
            partial = Partial(home / "parts" / name, size)
            self._partial[owner, request.sha256] = partial
            partial.path.write_bytes(b"")
        return partial

    def _finish(self, owner: bytes, offer: Offer, sha256: bytes) -> None:
        partial = self._partial.pop((owner, sha256))
        if partial.running.digest() != sha256:
            partial.path.unlink()
            raise RefusedError("SnapshotIntegrityError", "a file arrived with another hash")
        offer.store.take(partial.path, sha256, partial.size)
        offer.reserved -= blob_charge(offer.missing.pop(sha256))

    def _give_up(self, owner: bytes, sha256: bytes) -> None:
        partial = self._partial.pop((owner, sha256), None)
        if partial is not None:
            partial.path.unlink(missing_ok=True)

    def forget(self, owner: bytes) -> None:
        """Remove the unfinished uploads of a client that has gone."""
        self._offers.pop(owner, None)
        for bringer, sha256 in list(self._partial):
            if bringer == owner:
                self._give_up(owner, sha256)

    def tree(self, key: bytes, snapshot: str) -> str:
        """Returns the path of a client's snapshot. Raises ``RefusedError``: it is not uploaded."""
        if _SNAPSHOT.fullmatch(snapshot):
            tree = self._store(key).tree(snapshot.removeprefix(PREFIX))
            if tree.is_dir():
                return str(tree)
        raise RefusedError("WorkerError", "this server has no such snapshot; offer it first")

    def used_bytes(self, key: bytes) -> int:
        """Returns the bytes of a client's files, offered ones included, in the quota."""
        return self._charged(self._store(key))

    def _alone(self) -> contextlib.AbstractContextManager[bool]:
        """A context that yields whether no other server uses the folder, and keeps others out."""
        return contextlib.nullcontext(True) if self._use is None else self._use.alone()

    def _store(self, key: bytes) -> BlobStore:
        name = SHARED if self._use is not None else key.hex()[:32] or "local"
        if name not in self._stores:
            self._stores[name] = BlobStore(self.folder / name)
        return self._stores[name]

    def _offered(self, store: BlobStore) -> list[Offer]:
        return [offer for offer in self._offers.values() if offer.store is store]

    def _charged(self, store: BlobStore) -> int:
        return store.held + sum(offer.reserved for offer in self._offered(store))

    def _make_room(self, store: BlobStore, in_use: Collection[str]) -> None:
        """Remove the longest unused snapshots until the whole offer fits."""
        if self._fits(store):
            return
        with self._alone() as alone:
            if alone:
                keep = {sha256 for offer in self._offered(store) for sha256 in offer.needed}
                store.remove_unlinked(keep)
                for digest in store.unused(in_use):
                    if self._fits(store):
                        return
                    store.remove(digest)
                    store.remove_unlinked(keep)
        if not self._fits(store):
            raise RefusedError(
                "WorkerError",
                "your key's snapshots would take more than the server's quota of "
                f"{size_text(self._quotas.upload_bytes)} (--max-upload), or be more than "
                f"{MAX_TREES}; the others are used by open environments, or uploaded by other "
                "processes of yours",
            )

    def _fits(self, store: BlobStore) -> bool:
        trees = store.trees + len(self._offered(store))
        return trees <= MAX_TREES and self._charged(store) <= self._quotas.upload_bytes


def checked_listing(files: tuple[object, ...], quotas: Quotas) -> list[ListedFile]:
    """Checks every entry of a listing; returns it sorted by path.

    Trust: input from a client: names become paths of this machine.
    Raises ``RefusedError``: the text names the broken rule.
    """
    if not 1 <= len(files) <= quotas.upload_files:
        raise RefusedError(
            "WorkerError",
            f"a snapshot has 1 to {quotas.upload_files} files here (--max-upload-files), this one "
            f"has {len(files)}",
        )
    listed = sorted((_listed(file) for file in files), key=attrgetter("path"))
    total = sum(file.size for file in listed)
    if total > quotas.upload_bytes:
        raise RefusedError(
            "WorkerError",
            f"a snapshot of {size_text(total)} is over the server's quota of "
            f"{size_text(quotas.upload_bytes)} "
            "(--max-upload)",
        )
    steps = sum(file.path.count("/") + 1 for file in listed)
    if steps > MAX_STEPS:
        raise RefusedError(
            "WorkerError", f"a snapshot has {steps} parts of paths, over {MAX_STEPS}"
        )
    _check_tree([file.path for file in listed])
    return listed


def _listed(file: object) -> ListedFile:
    parts = file if type(file) is tuple else ()
    executable = parts[3:] == (True,)
    if [type(part) for part in parts] != [str, int, bytes, *[bool] * executable]:
        raise RefusedError("LocalProtocolError", "a file is (path, size, sha256[, True])")
    path, size, sha256 = parts[:3]
    if size < 0 or len(sha256) != _SHA256_BYTES:
        raise RefusedError("LocalProtocolError", "a file is (path, size, sha256[, True])")
    wrong = wrong_with_path(path)
    if wrong:
        raise RefusedError("LocalProtocolError", f"the file {path[:200]!r} {wrong}")
    return ListedFile(path, size, sha256, executable)


def wrong_with_path(path: str) -> str:
    """Returns why a relative path is refused; empty if it is allowed."""
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


def digest_of(files: list[ListedFile]) -> str:
    """The name of a snapshot: a hash of its sorted listing."""
    rows = [[file.path, file.size, file.sha256.hex(), *[True] * file.executable] for file in files]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()

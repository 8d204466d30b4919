"""Snapshots: a repository's files at one commit, downloaded, verified, and never imported here.

``fetch`` resolves a revision once, holds the listing against limits, downloads the whole
repository through huggingface_hub, compares every file with the listing's hash, and lays it out
read-only in a store of our own. A full commit that is in the store costs no request.
``local`` does the same for a folder of this machine. See ``docs/snapshots.md``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from envhub_sandbox.errors import (
    HubReferenceError,
    RepositoryUnavailableError,
    SnapshotError,
    SnapshotTooLargeError,
)
from envhub_sandbox.hub import store as store
from envhub_sandbox.hub.candidate import Candidate, missing_entry
from envhub_sandbox.hub.client import HubClient, Repository, checked_endpoint, checked_token
from envhub_sandbox.hub.failures import ABSENT, UNREACHABLE, HubFailure, Kind
from envhub_sandbox.hub.listing import (
    DEFAULT_LIMITS,
    FileRecord,
    Snapshot,
    SnapshotLimits,
    check_names,
    within_limits,
)
from envhub_sandbox.hub.local import (
    LocalFile,
    LocalFolder,
    content_commit,
    copier,
    hash_files,
    split_local,
)
from envhub_sandbox.hub.reference import DEFAULT_PATH, HubRef, is_local

__all__ = ["FileRecord", "Snapshot", "SnapshotLimits", "fetch", "local"]

_SHOWN_COMMITS = 5
_LOCAL_COPIES_DAYS = 14.0
_ALL_COUNTS = (
    "It is in no git checkout, so every file in it counts. Move away what does not belong to the "
    "repository, or run 'git init' there and name it in .gitignore"
)
T = TypeVar("T")


def named(
    reference: str,
    *,
    hub_cache_dir: str | Path | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
) -> Snapshot:
    """The snapshot of a hub reference or of a local folder; raises as ``fetch`` and ``local`` do.

    The path of a ``.py`` file that is here means that file. A reference that is also a folder here
    gets a hint.
    """
    if is_here(reference):
        return local(reference)
    try:
        ref = HubRef.parse(reference)
        return fetch(ref, hub_cache_dir=hub_cache_dir, token=token, endpoint=endpoint)
    except (HubReferenceError, SnapshotError) as error:
        if os.path.exists(reference.partition(":")[0]):
            hint = f"There is such a folder here; for it, write './{reference}'."
            error.args = (f"{error}\n{hint}",)
        raise


def is_here(reference: str) -> bool:
    """Whether a reference names a folder or a file of this machine."""
    return is_local(reference) or (reference.endswith(".py") and os.path.isfile(reference))


def commit_of(
    reference: str,
    *,
    hub_cache_dir: str | Path | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
) -> str:
    """The commit that a reference means now; raises as ``named`` does.

    Nothing is downloaded or copied, and a full commit costs no request. Whether it has the entry
    file is not looked at.
    """
    if is_here(reference):
        root, _ = split_local(reference, DEFAULT_PATH)
        return content_commit(_found_here(LocalFolder.at(root), DEFAULT_LIMITS)[1])
    ref = HubRef.parse(reference)
    if ref.is_pinned and ref.revision is not None:
        return ref.revision
    hub = HubClient(checked_endpoint(endpoint), checked_token(token), hub_cache_dir)
    candidates = _candidates(ref, hub, DEFAULT_LIMITS)
    try:
        return _first(candidates, Candidate.resolved)
    except HubFailure as failure:
        raise _unavailable(candidates, [failure]) from failure.__cause__


def fetch(
    ref: HubRef,
    *,
    hub_cache_dir: str | Path | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
    limits: SnapshotLimits = DEFAULT_LIMITS,
) -> Snapshot:
    """Bring a repository's files here, verified.

    Args:
        ref: What to fetch. A full commit that is in the store costs no request; a branch or tag
            is always asked for, so that nothing stale is taken for it.
        hub_cache_dir: huggingface_hub's ``cache_dir``, where downloads land before they are
            verified. The store itself is at ``$ENVHUB_CACHE`` or in the user's cache folder.
        token: As in huggingface_hub: None for the stored one, False for none.
        endpoint: As in huggingface_hub: None for ``$HF_ENDPOINT`` or https://huggingface.co.
        limits: What the repository may bring.

    Raises:
        RepositoryUnavailableError: No such repository, revision or file, no access, no Hub. The
            text says which, and ``__cause__`` is the Hub client's error.
        SnapshotTooLargeError: Over the limits; nothing was downloaded.
        SnapshotIntegrityError: A file is not what the commit's listing says.
        SnapshotError: A hostile name in the listing, or the store cannot be written.
        HubReferenceError: The token or endpoint cannot be one.
    """
    hub = HubClient(checked_endpoint(endpoint), checked_token(token), hub_cache_dir)
    candidates = _candidates(ref, hub, limits)
    try:
        return _first_stored(candidates) or _first(candidates, Candidate.fetched)
    except HubFailure as failure:
        raise _unavailable(candidates, [failure]) from failure.__cause__
    except store.HalfDeletedError as half:
        return _fetched_again(candidates, half)


def _candidates(ref: HubRef, hub: HubClient, limits: SnapshotLimits) -> list[Candidate]:
    kinds = (ref.repo_type,) if ref.repo_type else ("model", "space")
    return [Candidate(ref, Repository(kind, ref.repo_id), hub, limits) for kind in kinds]


def _fetched_again(candidates: list[Candidate], half: store.HalfDeletedError) -> Snapshot:
    """What is left of it stays, until there is all of it."""
    try:
        return _first(candidates, Candidate.fetched)
    except HubFailure as failure:
        error, cause = _unavailable(candidates, [failure]), failure.__cause__
    except RepositoryUnavailableError as unavailable:
        error, cause = unavailable, unavailable.__cause__
    error.args = (f"{half}\nThat was tried: {error}",)
    raise error from cause


def _first_stored(candidates: list[Candidate]) -> Snapshot | None:
    if not candidates[0].ref.is_pinned:
        return None
    stored = (candidate.stored() for candidate in candidates)
    return next((snapshot for snapshot in stored if snapshot is not None), None)


def _first(candidates: list[Candidate], ask: Callable[[Candidate], T]) -> T:
    failures: list[HubFailure] = []
    for candidate in candidates:
        try:
            return ask(candidate)
        except HubFailure as failure:
            if failure.kind not in ABSENT:
                raise
            failures.append(failure)
    raise _unavailable(candidates, failures) from failures[0].__cause__


def _unavailable(
    candidates: list[Candidate], failures: list[HubFailure]
) -> RepositoryUnavailableError:
    """One error for all that was tried; the furthest attempt gives the advice."""
    ref, hub = candidates[0].ref, candidates[0].hub
    whats = "; and ".join(dict.fromkeys(failure.what for failure in failures))
    best = next((f for f in failures if f.kind is not Kind.NO_REPOSITORY), failures[0])
    advice = best.advice
    if best.kind is Kind.NO_REPOSITORY and ref.repo_type is None:
        advice += f". A dataset repository is written 'datasets/{ref.repo_id}'"
    in_store = "" if best.kind is Kind.NO_ENTRY else _in_store(candidates, best.kind in UNREACHABLE)
    return RepositoryUnavailableError(
        f"{ref} on {hub.public_endpoint}: {whats}. {advice}.{in_store}"
    )


def _in_store(candidates: list[Candidate], even_if_none: bool) -> str:
    """Which commits can be had without the Hub, and how to write them."""
    ref = candidates[0].ref
    found = [stored for candidate in candidates for stored in store.commits(candidate.folder)]
    others = [stored for stored in found if stored.commit != ref.revision][:_SHOWN_COMMITS]
    if not others:
        return " No commit of it is in the store to fall back on." if even_if_none else ""
    shown = ", ".join(
        f"'{replace(ref, revision=stored.commit)}' "
        f"({stored.revision or 'pinned'}, {stored.fetched[:10]})"
        for stored in others
    )
    return f" These are in the store and need no Hub: {shown}."


def local(
    folder: str | Path, path: str = DEFAULT_PATH, *, limits: SnapshotLimits = DEFAULT_LIMITS
) -> Snapshot:
    """Copy a folder of this machine into the store, by content: unchanged is the same snapshot.

    In a git checkout that is what git would commit, and elsewhere every file; see ``hub.local``.

    Args:
        folder: A folder, ``folder:path/env.py``, or a ``.py`` file (whose folder is taken).
        path: The entry file in the folder, unless ``folder`` names one.
        limits: What the folder may bring.

    Raises:
        RepositoryUnavailableError: There is no such folder or entry file.
        SnapshotTooLargeError: Over the limits.
        SnapshotError: A link leaves the folder, a file cannot be read, or has a name that the Hub
            cannot have.
    """
    root, path = split_local(str(folder), path)
    here, title = LocalFolder.at(root), f"local folder {root}"
    found, files = _found_here(here, limits)
    if all(file.path != path for file in files):
        what, advice = _left_out(here, path) or missing_entry(path, files)
        raise RepositoryUnavailableError(f"{title} {what}. {advice}")
    slot = store.Slot(store.local_folder(), content_commit(files), title)
    if store.load_whole(slot) is None:
        store.publish(slot, files, copier(found, title), {"repo_type": "local"})
        # Every edit leaves a copy; a Hub commit, in contrast, is kept until somebody removes it.
        store.remove_unused(slot.folder, days=_LOCAL_COPIES_DAYS)
    store.mark_used(slot)
    return Snapshot(str(root), "local", slot.commit, path, slot.tree, files)


def _left_out(here: LocalFolder, path: str) -> tuple[str, str] | None:
    """What to say of an entry that is there, and that git would not commit."""
    for one in here.left_out():
        if f"{path}/".startswith(f"{one.path.rstrip('/')}/"):
            what = f"has the file {path!r}, but git would not commit it"
            if one.is_repository:
                return what, f"{one.path} is a git repository of its own; name that one"
            return what, f"Run 'git add --force {path}', or take it out of .gitignore"
    return None


def _found_here(
    here: LocalFolder, limits: SnapshotLimits
) -> tuple[tuple[LocalFile, ...], tuple[FileRecord, ...]]:
    try:
        found = within_limits(here.files(), limits, str(here))
    except OSError as error:
        raise SnapshotError(f"{here}: it cannot be read: {error}") from error
    except SnapshotTooLargeError as error:
        if here.checkout is None:
            error.args = (f"{error}. {_ALL_COUNTS}",)
        raise
    files = hash_files(found, str(here))
    check_names(files, str(here))
    return found, files

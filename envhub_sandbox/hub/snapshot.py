"""Snapshots: a repository's files at one commit, downloaded and verified, never imported here.

``fetch`` resolves a revision once, checks the listing against limits, downloads the whole
repository by huggingface_hub, compares every file with the listing's hash, and puts it read-only
into a store of our own. A full commit that is in the store costs no request.
``local`` does the same for a folder of this machine. See ``docs/snapshots.md``.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from envhub_sandbox.errors import (
    HubReferenceError,
    RepositoryUnavailableError,
    SnapshotError,
    SnapshotIntegrityError,
)
from envhub_sandbox.hub import store as store
from envhub_sandbox.hub.answers import ABSENT, UNREACHABLE, HubFailure, Kind
from envhub_sandbox.hub.client import HubClient, checked_endpoint, checked_token
from envhub_sandbox.hub.grammar import FOLDER
from envhub_sandbox.hub.listing import (
    DEFAULT_LIMITS,
    SHA256,
    FileRecord,
    Repository,
    RepositoryHost,
    Snapshot,
    SnapshotLimits,
    check_listing_names,
    content_digest,
    listing_within_limits,
)
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.hub.reference import (
    DEFAULT_PATH,
    GIT,
    PYPI,
    HubRef,
    is_local,
    is_of_another_place,
)
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import extras
from envhub_sandbox.system.log import SNAPSHOT, tell, warn_caller
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import first_of

__all__ = ["FileRecord", "Snapshot", "SnapshotLimits", "fetch", "local"]

_SHOWN_COMMITS = 5
_COPIES_DAYS = 14.0
_SHOWN_FILES = 20
T = TypeVar("T")


def snapshot_named(reference: str, *, allow_secrets: bool = False, **hub: Any) -> Snapshot:
    """The snapshot of a hub reference or a local folder; raises as ``fetch`` and ``local`` do.

    The path of an existing ``.py`` file or folder is local, with a warning if it could also be a
    repository of the Hub. ``hub`` are the arguments ``hub_cache_dir``, ``token``, ``endpoint`` and
    ``public`` of ``fetch``.
    """
    if is_here(reference):
        _warn_of_two_meanings(reference)
        return local(reference, allow_secrets=allow_secrets)
    try:
        return fetch(HubRef.parse(reference), **hub)
    except (HubReferenceError, SnapshotError) as error:
        if os.path.isdir(reference.partition("/")[0]):
            hint = f"For something in the folder of that name here, write './{reference}'."
            error.args = (f"{error}\n{hint}",)
        raise


def is_here(reference: str) -> bool:
    """Whether a reference names an existing local folder or file, or a .py file in an existing
    folder. A reference with a revision or a prefix such as ``pypi:`` is never local.
    """
    if is_local(reference) or (reference.endswith(".py") and os.path.isfile(reference)):
        return True
    folder, colon, _ = reference.partition(":")
    if not colon and folder.endswith(".py"):
        folder = os.path.dirname(folder)  # the file's name may be mistyped
    is_other = "@" in reference or "://" in reference or is_of_another_place(reference)
    return not is_other and os.path.isdir(folder)


def _warn_of_two_meanings(reference: str) -> None:
    """Warn if an existing folder is used although a repository of the Hub may have its name."""
    if is_local(reference) or not os.path.isdir(reference.partition(":")[0]):
        return
    with contextlib.suppress(HubReferenceError):
        ref = HubRef.parse(reference)
        warn_caller(
            f"{reference!r} is a folder here, and is taken as that. Write './{reference}' to say "
            f"so, or '{replace(ref, revision='main')}' for the repository of that name on the Hub",
        )


def fetch(
    ref: HubRef,
    *,
    hub_cache_dir: str | Path | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
    limits: SnapshotLimits = DEFAULT_LIMITS,
    needs_entry: bool = True,
    public: bool = False,
) -> Snapshot:
    """Fetch a repository's files, verified, into the store.

    Args:
        ref: The reference. A full commit that is in the store costs no request; a branch or tag is
            always resolved anew, so that it is never stale.
        hub_cache_dir: huggingface_hub's ``cache_dir``, where downloads land before they are
            verified. The store itself is at ``$ENVHUB_CACHE`` or in the user's cache folder.
        token: As in huggingface_hub: None for the stored one, False for none.
        endpoint: As in huggingface_hub: None for ``$HF_ENDPOINT`` or https://huggingface.co.
        limits: Bounds on the repository's files.
        needs_entry: False for a repository without an environment, which may be of any type.
        public: Only fetch what the Hub gives to everybody, without a login, since a stranger chose
            the reference. A commit in the store that needed a login does not count.

    Raises:
        RepositoryUnavailableError: The repository, revision or file does not exist, or access or
            the Hub is missing. ``__cause__`` is the Hub client's error.
        SnapshotTooLargeError: Over the limits; nothing was downloaded.
        SnapshotIntegrityError: A file differs from the commit's listing.
        SnapshotError: The listing has a hostile name, or the store cannot be written.
        HubReferenceError: The token or endpoint is malformed.
    """
    if ref.repo_type == PYPI:
        return _registered(ref)
    if public:
        token, endpoint = False, without_login(checked_endpoint(endpoint))
    # The order matters. The store comes first, since a pin in it needs no request. Then the hosts
    # are asked in the order of the candidates: a model comes before a space of the same name. If a
    # snapshot in the store is half deleted, it is fetched again; its remains are moved aside only
    # when the new copy is complete.
    candidates = _candidates(ref, hub_cache_dir, token, endpoint, limits, needs_entry, public)
    try:
        for candidate in candidates if ref.is_pinned else ():
            if (stored := candidate.stored()) is not None:
                return stored
    except HubFailure as failure:
        raise _unavailable(candidates, [failure]) from failure.__cause__
    except store.HalfDeletedError as half:
        try:
            return _first(candidates, _Candidate.fetched)
        except RepositoryUnavailableError as error:
            error.args = (f"{half}\nThat was tried: {error}",)
            raise
    return _first(candidates, _Candidate.fetched)


def _candidates(
    ref: HubRef,
    hub_cache_dir: str | Path | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
    limits: SnapshotLimits = DEFAULT_LIMITS,
    needs_entry: bool = True,
    public: bool = False,
) -> Sequence[_Candidate]:
    """The repositories that a reference may mean, in the order to try them."""
    if ref.repo_type == GIT:
        host_of = extras.required("envhub_sandbox.extras.sources.git_commits", "GitHost", str(ref))
        scheme, _, rest = ref.repo_id.partition("://")
        address, _, name = rest.partition("/")
        host: RepositoryHost = host_of(f"{scheme}://{address}")
        return [_Candidate(ref, Repository(GIT, name), host, limits, needs_entry)]
    hub = HubClient(checked_endpoint(endpoint), checked_token(token), hub_cache_dir)
    every = ("model", "space") if needs_entry else ("model", "dataset", "space")
    kinds = (ref.repo_type,) if ref.repo_type else every
    repos = [Repository(kind, ref.repo_id) for kind in kinds]
    return [_Candidate(ref, repo, hub, limits, needs_entry, public) for repo in repos]


def _first(candidates: Sequence[_Candidate], ask: Callable[[_Candidate], T]) -> T:
    """The answer of the first candidate that exists; raises as ``fetch``."""
    failures: list[HubFailure] = []
    for candidate in candidates:
        try:
            return ask(candidate)
        except HubFailure as failure:
            if failure.kind not in ABSENT:
                raise _unavailable(candidates, [failure]) from failure.__cause__
            failures.append(failure)
    raise _unavailable(candidates, failures) from failures[0].__cause__


def _unavailable(
    candidates: Sequence[_Candidate], failures: list[HubFailure]
) -> RepositoryUnavailableError:
    """Make one error of all failed candidates; the one that came furthest gives the advice."""
    ref, endpoint = candidates[0].ref, candidates[0].host.public_endpoint
    whats = "; and ".join(dict.fromkeys(failure.what for failure in failures))
    best = next((f for f in failures if f.kind is not Kind.NO_REPOSITORY), failures[0])
    advice = best.advice
    if best.kind is Kind.NO_REPOSITORY and ref.repo_type is None and candidates[0].needs_entry:
        advice += f". A dataset repository is written 'datasets/{ref.repo_id}'"
    in_store = ""
    if best.kind is not Kind.NO_ENTRY and not candidates[0].public:
        in_store = _in_store(candidates, best.kind in UNREACHABLE)
    return RepositoryUnavailableError(f"{ref} on {endpoint}: {whats}. {advice}.{in_store}")


def _in_store(candidates: Sequence[_Candidate], even_if_none: bool) -> str:
    """A sentence that lists the repository's commits in the store, which need no Hub."""
    ref = candidates[0].ref
    commits = [stored for candidate in candidates for stored in store.commits(candidate.folder)]
    others = [stored for stored in commits if stored.commit != ref.revision][:_SHOWN_COMMITS]
    if not others:
        return " No commit of it is in the store to fall back on." if even_if_none else ""
    shown = ", ".join(
        f"'{replace(ref, revision=stored.commit)}' "
        f"({stored.revision or 'pinned'}, {stored.fetched[:10]})"
        for stored in others
    )
    return f" These are in the store and need no Hub: {shown}."


def with_assets(
    snapshot: Snapshot, assets: Sequence[str], hub: Mapping[str, Any], locked: Sequence[str] = ()
) -> Snapshot:
    """Add assets to a snapshot: see ``extras.sources.assets``. Without that extra, assets that the
    repository's card names are ignored. Raises ``SandboxUnavailableError``: the caller names some.
    """
    module, name = "envhub_sandbox.extras.sources.assets", "with_assets"
    if assets or locked:
        extras.required(module, name, option_name("assets"))
    if (extra := extras.find(module, name)) is not None:
        snapshot = extra(snapshot, assets, hub, locked)
    return snapshot


def local(folder: str | Path, *, allow_secrets: bool = False) -> Snapshot:
    """Copy a local folder into the store; an unchanged folder gives the same snapshot.

    ``folder`` may also be ``folder:path/env.py``. The snapshot of a ``.py`` file has the files that
    it imports from its folder, and those that git tracks. The snapshot of a folder has the files
    that git would commit, or every file outside of a checkout; see ``hub.local``. A line for the
    user says which files the code can see.

    Args:
        allow_secrets: Whether a folder may hold keys or be a home directory.

    Raises:
        RepositoryUnavailableError: The folder or the entry file does not exist.
        SnapshotError: A link leaves the folder, or a file has a name that the Hub cannot have;
            ``SnapshotTooLargeError`` over the limits.
        PolicyError: The folder holds keys, or is a home directory.
    """
    from envhub_sandbox.hub.local import copier, split_local  # no pin needs it

    named = split_local(str(folder))
    source, listing = named.listed(allow_secrets=allow_secrets)
    files, path = listing.records, named.path
    if all(file.path != path for file in files):
        lack, advice = source.why_left_out(path) or _missing_entry(path, files)
        raise RepositoryUnavailableError(f"{source} {lack}. {advice}")
    tell(source.seen(listing), SNAPSHOT)
    source.warn_of_requirements(listing)
    copy = copier(listing.files, str(source))
    snapshot = _by_content(FOLDER, str(named.folder), path, files, copy)
    return replace(snapshot, repo_type=named.repo_type)


def _registered(ref: HubRef) -> Snapshot:
    """The snapshot of one generated file that makes an environment of a package."""
    text: bytes = extras.required("envhub_sandbox.extras.sources.registered", "entry", str(ref))(
        ref.parts
    )
    digest = f"{SHA256}:{hashlib.sha256(text).hexdigest()}"
    files = (FileRecord(DEFAULT_PATH, len(text), digest),)
    name = str(ref).partition(":")[2]

    def write(_: FileRecord, target: Path) -> None:
        target.write_bytes(text)

    return _by_content(PYPI, name, DEFAULT_PATH, files, write)


def _by_content(
    kind: str,
    name: str,
    path: str,
    files: tuple[FileRecord, ...],
    copy: Callable[[FileRecord, Path], None],
) -> Snapshot:
    """A snapshot whose commit is a hash of its content."""
    commit = f"{kind}-{content_digest(files)}"
    slot = store.Slot(store.folder_of(kind), commit, f"{kind} {name}")
    if store.load_whole(slot) is None:
        store.publish(slot, files, copy, {"repo_type": kind, "repo_id": name})
        # Every edit makes a copy, so old copies are removed; commits of the Hub are kept.
        store.remove_unused(slot.folder, days=_COPIES_DAYS)
    store.mark_used(slot)
    return Snapshot(name, kind, slot.commit, path, slot.tree, files)


@dataclass(frozen=True)
class _Candidate:
    """A reference, read as a repository of one type. Raises ``HubFailure``, ``SnapshotError``.
    ``public``: see ``fetch``; git has no logins.
    """

    ref: HubRef
    repo: Repository
    host: RepositoryHost
    limits: SnapshotLimits
    needs_entry: bool
    public: bool = False

    @property
    def folder(self) -> Path:
        """The folder of the repository's commits in the store."""
        return store.repository_folder(self.host.public_endpoint, *self.repo)

    def stored(self) -> Snapshot | None:
        """The pinned commit if it is in the store, by no request. Raises ``HalfDeletedError``."""
        slot = self._slot(self.ref.revision or "")
        files = store.load(slot)
        hidden = self.public and not store.is_public(slot)
        return None if files is None or hidden else self._finished(slot, files)

    def fetched(self) -> Snapshot:
        """The revision as the host resolves it now, downloaded unless it is in the store."""
        slot = self._slot(self.resolved())
        files = store.load_whole(slot)
        if files is None:
            self._bring(slot)
            files = store.load(slot)
        if files is None:
            raise SnapshotError(f"{slot.title}: it was removed from the store meanwhile; try again")
        if self.public and not store.is_public(slot) and not self._note_whether_public(slot):
            reason = f"the {self.repo.repo_type} repository is not given without a login"
            raise HubFailure(Kind.GATED, reason, "Only those without a login are used here")
        return self._finished(slot, files)

    def _note_whether_public(self, slot: store.Slot) -> bool:
        """Find out whether the host gives a commit to everybody; if so, the store remembers it."""
        host = self.host
        public = not isinstance(host, HubClient) or host.is_public(self.repo, slot.commit)
        if public:
            store.mark_public(slot)
        return public

    def resolved(self) -> str:
        """The commit that the revision is at the host now; raises if a pin resolves to another."""
        commit = self.host.resolve(self.repo, self.ref.revision)
        if self.ref.is_pinned and commit != self.ref.revision:
            raise SnapshotIntegrityError(
                f"{self.ref}: {self.host.public_endpoint} answered with another commit, {commit}, "
                "than the pinned one. Do not trust this endpoint; use another"
            )
        return commit

    def _bring(self, slot: store.Slot) -> None:
        with self.host.files(self.repo, slot.commit) as source:
            # The listing is a stranger's text, so the whole listing is checked before any file is
            # downloaded:
            #
            # 1. Sizes and the number of files, while the pages of the listing come.
            # 2. Names, before any of them becomes a path here or in the Hub client's cache.
            # 3. Names that this file system cannot keep apart.
            # 4. The entry file, so that a mistyped one costs no download.
            #
            # Only then the files are downloaded, hashed while they are written, and published by
            # one rename.
            files = listing_within_limits(source.listing, self.limits, slot.title)
            check_listing_names(files, slot.title)
            store.refuse_clashes(slot, files)
            self._require_entry(files)
            size = sum(file.size for file in files)
            SNAPSHOT.info("%s: downloading %d files, %d bytes", slot.title, len(files), size)
            note = {"endpoint": self.host.public_endpoint, **self.repo._asdict()}
            note["revision"] = None if self.ref.is_pinned else self.ref.usual_revision
            store.publish(slot, files, source.copier(files, slot.title), note)
        if isinstance(self.host, HubClient) and not self.host.has_login():
            self._note_whether_public(slot)
        SNAPSHOT.info("%s: verified, and in the store", slot.title)

    def _slot(self, commit: str) -> store.Slot:
        title = f"{'/'.join(self.repo)}@{commit} on {self.host.public_endpoint}"
        return store.Slot(self.folder, commit, title)

    def _finished(self, slot: store.Slot, files: tuple[FileRecord, ...]) -> Snapshot:
        listing_within_limits(files, self.limits, slot.title)
        self._require_entry(files)
        ref, kind = self.ref, self.repo.repo_type
        return Snapshot(ref.repo_id, kind, slot.commit, ref.path, slot.tree, files, ref.revision)

    def _require_entry(self, files: tuple[FileRecord, ...]) -> None:
        if self.needs_entry and all(file.path != self.ref.path for file in files):
            lack, advice = _missing_entry(self.ref.path, files)
            raise HubFailure(Kind.NO_ENTRY, f"the {self.repo.repo_type} repository {lack}", advice)


def _missing_entry(path: str, files: tuple[FileRecord, ...]) -> tuple[str, str]:
    """The text and advice for a missing entry file, with the existing ``.py`` files."""
    names = [file.path for file in files if file.path.endswith(".py")]
    lack = f"has no file {path!r}"
    if not names:
        return lack, "It has no .py file, so it is not an environment"
    import difflib

    close = difflib.get_close_matches(path, names, n=1) or names
    shown = ", ".join(first_of(list(map(repr, names)), _SHOWN_FILES))
    return lack, f"Name the entry file after a colon, as in ':{close[0]}'; it has {shown}"

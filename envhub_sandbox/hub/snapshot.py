"""Snapshots: a repository's files at one commit, downloaded, verified, and never imported here.

``fetch`` resolves a revision once, holds the listing against limits, downloads the whole
repository through huggingface_hub, compares every file with the listing's hash, and lays it out
read-only in a store of our own. A full commit that is in the store costs no request.
``local`` does the same for a folder of this machine. See ``docs/snapshots.md``.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
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
from envhub_sandbox.system.log import SNAPSHOT, tell
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import first_of

__all__ = ["FileRecord", "Snapshot", "SnapshotLimits", "fetch", "local"]

_SHOWN_COMMITS = 5
_COPIES_DAYS = 14.0
_SHOWN_FILES = 20
T = TypeVar("T")


def snapshot_named(reference: str, *, allow_secrets: bool = False, **hub: Any) -> Snapshot:
    """The snapshot of a hub reference or of a local folder; raises as ``fetch`` and ``local`` do.

    The path of a ``.py`` file or of a folder that is here means that, with a warning where it could
    be a repository of the Hub. ``hub`` are ``hub_cache_dir``, ``token``, ``endpoint`` and
    ``public``, as ``fetch`` takes them.
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
    """Whether a reference names a folder or a file of this machine, or a .py file in a folder that
    is here. What has a revision never does, nor what says that it is something else, as ``pypi:``.
    """
    if is_local(reference) or (reference.endswith(".py") and os.path.isfile(reference)):
        return True
    folder, colon, _ = reference.partition(":")
    if not colon and folder.endswith(".py"):
        folder = os.path.dirname(folder)  # its name may be mistyped
    is_other = "@" in reference or "://" in reference or is_of_another_place(reference)
    return not is_other and os.path.isdir(folder)


def _warn_of_two_meanings(reference: str) -> None:
    """A folder that is here comes before a repository of the Hub, and not in silence."""
    if is_local(reference) or not os.path.isdir(reference.partition(":")[0]):
        return
    with contextlib.suppress(HubReferenceError):
        ref = HubRef.parse(reference)
        warnings.warn(
            f"{reference!r} is a folder here, and is taken as that. Write './{reference}' to say "
            f"so, or '{replace(ref, revision='main')}' for the repository of that name on the Hub",
            stacklevel=2,
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
    """Bring a repository's files here, verified.

    Args:
        ref: What to fetch. A full commit that is in the store costs no request; a branch or tag
            is always asked for, so that nothing stale is taken for it.
        hub_cache_dir: huggingface_hub's ``cache_dir``, where downloads land before they are
            verified. The store itself is at ``$ENVHUB_CACHE`` or in the user's cache folder.
        token: As in huggingface_hub: None for the stored one, False for none.
        endpoint: As in huggingface_hub: None for ``$HF_ENDPOINT`` or https://huggingface.co.
        limits: What the repository may bring.
        needs_entry: False for one that is no environment: it may be of any type.
        public: Only what everybody is given, without a login: for what a stranger names. What is
            in the store because the caller's login has brought it is no answer.

    Raises:
        RepositoryUnavailableError: No such repository, revision or file, no access, no Hub. The
            text says which, and ``__cause__`` is the Hub client's error.
        SnapshotTooLargeError: Over the limits; nothing was downloaded.
        SnapshotIntegrityError: A file is not what the commit's listing says.
        SnapshotError: A hostile name in the listing, or the store cannot be written.
        HubReferenceError: The token or endpoint cannot be one.
    """
    if ref.repo_type == PYPI:
        return _registered(ref)
    if public:
        token, endpoint = False, without_login(checked_endpoint(endpoint))
    # The store first, since a pin that is there needs no request; then the hosts, in the order of
    # the candidates: a model comes before a space of the same name.
    candidates = _candidates(ref, hub_cache_dir, token, endpoint, limits, needs_entry, public)
    try:
        for candidate in candidates if ref.is_pinned else ():
            if (stored := candidate.stored()) is not None:
                return stored
    except HubFailure as failure:
        raise _unavailable(candidates, [failure]) from failure.__cause__
    except store.HalfDeletedError as half:
        try:  # what is left of it stays, until there is all of it
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
    """As what it may be read."""
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
    """The answer of the first candidate that is there; raises as ``fetch``."""
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
    """One error for all that was tried; the furthest attempt gives the advice."""
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
    """Which commits can be had without the Hub, and how to write them."""
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
    """The snapshot with its assets: see ``extras.sources.assets``. Without that extra a card's are
    not looked for. Raises ``SandboxUnavailableError``: others are asked for.
    """
    module, name = "envhub_sandbox.extras.sources.assets", "with_assets"
    if assets or locked:
        extras.required(module, name, option_name("assets"))
    if (extra := extras.find(module, name)) is not None:
        snapshot = extra(snapshot, assets, hub, locked)
    return snapshot


def local(folder: str | Path, *, allow_secrets: bool = False) -> Snapshot:
    """Copy a folder of this machine into the store, by content: unchanged is the same snapshot.

    It may also be ``folder:path/env.py``. Of a ``.py`` file it is what the file imports of its
    folder, and what git tracks there. In a git checkout a folder is what git would commit, and
    elsewhere every file; see ``hub.local``. What the code gets to see is told in a line.

    Args:
        allow_secrets: Whether a folder may hold keys or be a home directory.

    Raises:
        RepositoryUnavailableError: There is no such folder or entry file.
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
    """The repository of one file that stands for an environment of a package."""
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
    """A snapshot that is named by what is in it."""
    commit = f"{kind}-{content_digest(files)}"
    slot = store.Slot(store.folder_of(kind), commit, f"{kind} {name}")
    if store.load_whole(slot) is None:
        store.publish(slot, files, copy, {"repo_type": kind, "repo_id": name})
        # Every edit leaves a copy; a Hub commit, in contrast, is kept until somebody removes it.
        store.remove_unused(slot.folder, days=_COPIES_DAYS)
    store.mark_used(slot)
    return Snapshot(name, kind, slot.commit, path, slot.tree, files)


@dataclass(frozen=True)
class _Candidate:
    """A reference read as a repository of one type. Raises ``HubFailure`` and ``SnapshotError``.
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
        """Where the repository's commits lie in the store."""
        return store.repository_folder(self.host.public_endpoint, *self.repo)

    def stored(self) -> Snapshot | None:
        """The pinned commit, if it is in the store. No request. Raises ``HalfDeletedError``."""
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
            raise HubFailure(Kind.GATED, reason, "Only what needs none is taken here")
        return self._finished(slot, files)

    def _note_whether_public(self, slot: store.Slot) -> bool:
        """Whether the host gives it to everybody, which the store remembers; git has no logins."""
        host = self.host
        public = not isinstance(host, HubClient) or host.is_public(self.repo, slot.commit)
        if public:
            store.mark_public(slot)
        return public

    def resolved(self) -> str:
        """The commit that the revision is at the host now."""
        commit = self.host.resolve(self.repo, self.ref.revision)
        if self.ref.is_pinned and commit != self.ref.revision:
            raise SnapshotIntegrityError(
                f"{self.ref}: {self.host.public_endpoint} answered with another commit, {commit}, "
                "than the pinned one. Do not trust this endpoint; use another"
            )
        return commit

    def _bring(self, slot: store.Slot) -> None:
        with self.host.files(self.repo, slot.commit) as source:
            # The listing is a stranger's text, so it is judged whole before anything is fetched:
            # sizes and number while its pages come, then names, before any becomes a path here or
            # in the cache of the Hub's client; and a mistyped entry file costs no download.
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
    """What to say when a repository lacks the entry file: which ``.py`` files there are."""
    names = [file.path for file in files if file.path.endswith(".py")]
    lack = f"has no file {path!r}"
    if not names:
        return lack, "It has no .py file, so it is not an environment"
    import difflib

    close = difflib.get_close_matches(path, names, n=1) or names
    shown = ", ".join(first_of(list(map(repr, names)), _SHOWN_FILES))
    return lack, f"Name the entry file after a colon, as in ':{close[0]}'; it has {shown}"

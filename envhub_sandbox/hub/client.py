"""A client of the Hub, by huggingface_hub 0.34 to 2.x: resolves, lists and downloads.

Functions import the library only when they need it, since a pinned snapshot in the store does not.
The library downloads into its own cache, which is not trusted: the caller compares every file with
the listing.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from traceback import walk_tb
from typing import Any
from urllib.parse import parse_qsl, quote, urlsplit

from envhub_sandbox.errors import HubReferenceError, SnapshotError, SnapshotIntegrityError
from envhub_sandbox.hub.answers import (
    HostileAnswerError,
    HubFailure,
    bounded_body,
    chain,
    conceal,
    explain,
    guarded,
    streamed,
)
from envhub_sandbox.hub.grammar import is_commit
from envhub_sandbox.hub.listing import (
    GIT_SHA1,
    SHA256,
    CommitFiles,
    Copier,
    FileRecord,
    HashMismatch,
    Repository,
    copy_verified,
)
from envhub_sandbox.hub.logins import authorization, login_of, without_login
from envhub_sandbox.system.threads import Calls
from envhub_worker.protocol.records import dataclass

_DEFAULT_ENDPOINT = "https://huggingface.co"
_LIBRARY = {"library_name": "envhub-sandbox"}
_xet_switch = threading.Lock()
_WORKERS = 8
MAX_IDLE_PAGES = 1000
"""The most pages of a listing in a row without a file; folders alone can fill some pages."""


def default_endpoint() -> str:
    """The endpoint that huggingface_hub uses, without importing it."""
    constants = sys.modules.get("huggingface_hub.constants")
    chosen = getattr(constants, "ENDPOINT", None) or os.environ.get("HF_ENDPOINT")
    return str(chosen or _DEFAULT_ENDPOINT).rstrip("/")


def checked_endpoint(endpoint: str | None) -> str:
    """The endpoint without a trailing slash. Raises ``HubReferenceError``."""
    chosen = default_endpoint() if endpoint is None else endpoint.rstrip("/")
    shown = without_login(chosen)
    if "@" in shown:
        raise HubReferenceError(
            "endpoint: it has an @ after the host; write a user or password with such characters "
            "percent-encoded, as in https://user:p%2Fw@hub.example"
        )
    if not re.match(r"https?://[^/]", shown):
        raise HubReferenceError(
            f"endpoint: {shown!r} is not an http(s) URL such as {_DEFAULT_ENDPOINT!r}"
        )
    return chosen


def checked_token(token: str | bool | None) -> str | bool | None:
    """Strip and check a token. Raises ``HubReferenceError``, whose text never shows the token."""
    if not isinstance(token, str):
        return token
    stripped = token.strip()
    if not re.fullmatch(r"[!-~]+", stripped):
        raise HubReferenceError("token: it is empty or has characters that no token has")
    return stripped


@dataclass(frozen=True)
class HubClient:
    """One endpoint, one token, one Hub cache. Every method raises ``HubFailure``.

    Attributes:
        endpoint: The URL without a trailing slash; a login in it is sent as a header only.
        token: As in huggingface_hub: None for the stored token, False for no token.
        cache_dir: huggingface_hub's ``cache_dir``; None for its default.
    """

    endpoint: str = field(repr=False)
    token: str | bool | None = field(default=None, repr=False)
    cache_dir: str | Path | None = None

    @property
    def public_endpoint(self) -> str:
        """The endpoint without a user and password, for errors and as a key."""
        return without_login(self.endpoint)

    def resolve(self, repo: Repository, revision: str | None) -> str:
        """The full commit that a revision is now; None means ``main``, as in huggingface_hub."""
        with self._explained(repo, revision):
            commit = self._about(repo, revision or "main")["sha"]
            if not isinstance(commit, str) or not is_commit(commit):
                raise ValueError("the answer has no full commit")
        return commit

    def changed(self, repo: Repository, commit: str) -> str:
        """The day of a commit according to the Hub, such as ``"2024-05-31"``."""
        with self._explained(repo, commit):
            return str(self._about(repo, commit)["lastModified"])[:10]

    def is_public(self, repo: Repository, commit: str) -> bool:
        """Whether the Hub gives this commit to everybody without a login. Never raises."""
        everybody = replace(self, endpoint=self.public_endpoint, token=False)
        try:
            with everybody._explained(repo, commit):
                about = everybody._about(repo, commit)
                return (
                    about["sha"] == commit and not about.get("private") and not about.get("gated")
                )
        except (HubFailure, SnapshotError):
            return False

    def _about(self, repo: Repository, revision: str) -> Any:
        return self._get(f"{self._api(repo)}/revision/{quote(revision, safe='')}", {})[0]

    def listing(self, repo: Repository, commit: str) -> Iterator[FileRecord]:
        """Yield the files of a commit with their sizes and digests, page by page."""
        url = f"{self._api(repo)}/tree/{commit}"
        query: dict[str, str] | None = {"recursive": "true", "expand": "false"}
        idle = 0
        while query is not None:
            with self._explained(repo, commit):
                items, following = self._get(url, query)
                records = [_record_of(item, repo) for item in list(items)]
            files = [record for record in records if record is not None]
            idle = 0 if files else idle + 1
            if idle > MAX_IDLE_PAGES:
                raise SnapshotIntegrityError(
                    f"{repo.repo_id} on {self.public_endpoint}: its listing does not end: {idle} "
                    "pages without a file. Check that the endpoint is a Hugging Face Hub"
                )
            yield from files
            # only its query is used: with another host the link could send the token elsewhere
            further = None if following is None else dict(parse_qsl(urlsplit(following).query))
            query = None if further == query else further

    @contextmanager
    def files(self, repo: Repository, commit: str) -> Iterator[CommitFiles]:
        """The listing of a commit's files, and the function that copies them."""
        yield CommitFiles(self.listing(repo, commit), partial(self._copier, repo, commit))

    def _copier(
        self, repo: Repository, commit: str, files: Sequence[FileRecord], title: str
    ) -> Copier:
        """Download files into the Hub cache; returns a function that copies each into the store.

        Files are downloaded one by one, because ``snapshot_download`` fetches a listing of its own,
        which may differ from the checked one. After a failure or a Ctrl-C it does not wait for
        running downloads, since they only write whole files into the Hub cache.
        """
        with self._explained(repo, commit):
            downloads = [partial(self._download, repo, commit, file.path) for file in files]
            first = Calls(downloads, _WORKERS).results()[0]
        folder = first.parents[files[0].path.count("/")]

        def copy(record: FileRecord, target: Path) -> None:
            try:
                copy_verified(folder / record.path, target, record)
                return
            except HashMismatch:
                # the Hub cache may have an edited or incomplete file: download it again, once
                target.unlink(missing_ok=True)
            with self._explained(repo, commit):
                again = self._download(repo, commit, record.path, force_download=True)
            try:
                copy_verified(again, target, record)
            except HashMismatch as mismatch:
                raise SnapshotIntegrityError(
                    f"{title}: the file {record.path!r} came with other content than the "
                    f"commit's listing says: {mismatch.found}, not {record.size} bytes with "
                    f"{record.digest}. Nothing of it was used. A proxy, a mirror or the Hub cache "
                    f"changes files: try another network or endpoint, and remove the bad copy: "
                    f"rm '{again}'"
                ) from mismatch

        return copy

    def _download(self, repo: Repository, commit: str, path: str, **more: Any) -> Path:
        from huggingface_hub import hf_hub_download

        headers, token = self._login()
        arguments = {
            **repo._asdict(),
            "revision": commit,
            "filename": path,
            # not every version of the library expands "~" itself
            "cache_dir": None if self.cache_dir is None else os.path.expanduser(self.cache_dir),
            "token": token,
            "headers": headers,
            "endpoint": self.public_endpoint,
            **_LIBRARY,
            **more,
        }
        # in each download, because each thread may have a session of its own
        with guarded(import_module("huggingface_hub.utils").get_session()):
            return Path(_with_xet_or_without(hf_hub_download, **arguments))

    def _login(self) -> tuple[dict[str, str], str | bool | None]:
        """The header of the endpoint's login, and the token; a login replaces the token."""
        login = login_of(self.endpoint)
        if login is None:
            return {}, self.token
        return {"authorization": authorization(login)}, False

    def _api(self, repo: Repository) -> str:
        return f"{self.public_endpoint}/api/{repo.repo_type}s/{repo.repo_id}"

    def _get(self, url: str, query: dict[str, str]) -> tuple[Any, str | None]:
        """GET a URL; returns the answer's JSON and the URL of the next page, if any."""
        # not HfApi.list_repo_tree: it has no timeout, and in 2.x retries a broken Hub for 24 s
        client: Any = import_module("huggingface_hub.utils")
        timeout = import_module("huggingface_hub.constants").HF_HUB_ETAG_TIMEOUT
        options = {"headers": self._headers(), "params": query, "timeout": timeout}
        with streamed(client.get_session(), url, options) as response:
            client.hf_raise_for_status(response)
            return json.loads(bounded_body(response)), response.links.get("next", {}).get("url")

    def has_login(self) -> bool:
        """Whether requests carry a token, or the login of a mirror."""
        return any(name.lower() == "authorization" for name in self._headers())

    def _headers(self) -> dict[str, str]:
        client: Any = import_module("huggingface_hub.utils")
        login, token = self._login()
        return {**client.build_hf_headers(token=token, **_LIBRARY), **login}

    @contextmanager
    def _explained(self, repo: Repository, revision: str | None) -> Iterator[None]:
        try:
            yield
        except SnapshotError:
            raise
        except Exception as error:
            # first: the exception becomes the cause of ours, and tracebacks show its text
            from huggingface_hub import get_token

            token = self.token if isinstance(self.token, str) else get_token()
            login = login_of(self.endpoint)
            sent = (token, *self._login()[0].values(), login and login[1])
            secrets = tuple(secret for secret in sent if secret)
            conceal(error, secrets)
            hostile = [link for link in chain(error) if isinstance(link, HostileAnswerError)]
            if hostile:
                raise SnapshotIntegrityError(
                    f"{'/'.join(repo)}@{revision} on {self.public_endpoint}: {hostile[0]}. "
                    "Nothing of it was used. Check that the endpoint is a Hugging Face Hub, or use "
                    "another"
                ) from error
            subject = {**repo._asdict(), "revision": revision, "endpoint": self.public_endpoint}
            raise explain(error, secrets, **subject) from error


def _record_of(item: Any, repo: Repository) -> FileRecord | None:
    try:
        if item["type"] != "file":
            return None
        path, lfs = item["path"], item.get("lfs")
        size, digest = (lfs["size"], lfs["oid"]) if lfs else (item["size"], item["oid"])
        kind, length = (SHA256, 64) if lfs else (GIT_SHA1, 40)
        digest = digest.removeprefix("sha256:")
        if (
            type(path) is str
            and type(size) is int
            and size >= 0
            and re.fullmatch(rf"[0-9a-f]{{{length}}}", digest)
        ):
            path.encode()  # raises for a lone surrogate, which cannot be in a file's name
            return FileRecord(path, size, f"{kind}:{digest}")
        raise ValueError("a field has a wrong type")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise SnapshotIntegrityError(
            f"{repo.repo_id}: the Hub's listing has an entry that cannot be read ({error!r}); "
            "check that the endpoint is a Hugging Face Hub"
        ) from error


def _with_xet_or_without(download: Any, **arguments: Any) -> str:
    """Download a file; if the Xet route fails, as with some mirrors, download it over HTTP."""
    try:
        return str(download(**arguments))
    except Exception as error:
        if not _came_through_xet(error):
            raise
    with _xet_disabled():
        return str(download(**arguments))


def _came_through_xet(error: BaseException | None) -> bool:
    """Whether an exception came from the client's Xet route."""
    while error is not None:
        for frame, _ in walk_tb(error.__traceback__):
            module = str(frame.f_globals.get("__name__"))
            if module.startswith("huggingface_hub.") and "xet" in frame.f_code.co_name:
                return True
        error = error.__cause__
    return False


@contextmanager
def _xet_disabled() -> Iterator[None]:
    from huggingface_hub import constants

    with _xet_switch:
        before = constants.HF_HUB_DISABLE_XET
        constants.HF_HUB_DISABLE_XET = True
        try:
            yield
        finally:
            constants.HF_HUB_DISABLE_XET = before

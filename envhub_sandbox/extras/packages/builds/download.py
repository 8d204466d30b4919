"""Downloads sources of packages as data: one file of a known hash, or the files of a git commit.

The user's settings for uv and pip give the index, its logins, certificates and proxies.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import netrc
import os
import re
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO
from urllib.parse import unquote, urlsplit

from envhub_sandbox.errors import (
    DependencyError,
    HubReferenceError,
    SnapshotError,
    SnapshotTooLargeError,
)
from envhub_sandbox.extras.packages.builds.trees import Member, write_tree
from envhub_sandbox.extras.packages.request import Tell
from envhub_sandbox.extras.packages.resolution import index
from envhub_sandbox.extras.sources import git_commits as commits
from envhub_sandbox.hub.answers import HubFailure
from envhub_sandbox.hub.listing import copy_bounded
from envhub_sandbox.hub.logins import authorization, login_of, without_login
from envhub_worker.protocol.text import printable, size_text

MAX_BYTES = 512 * 2**20
_TIMEOUT_S = 60.0
_USER_AGENT = "envhub-sandbox"
_INDEXES = ("UV_DEFAULT_INDEX", "UV_INDEX", "UV_INDEX_URL", "UV_EXTRA_INDEX_URL")


def download(url: str, sha256: str, target: Path) -> None:
    """Download a URL to a file; refuse a missing file, too large a file or another hash."""
    shown = without_login(url)
    digest = hashlib.sha256()
    try:
        with _opened(url) as source, target.open("wb") as file:
            size = copy_bounded(source, file, MAX_BYTES, digest)
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise DependencyError(f"{shown} cannot be downloaded: {error}", reason="index") from error
    if size > MAX_BYTES:
        raise DependencyError(f"{shown} has more than {size_text(MAX_BYTES)}", reason="size")
    if (actual := digest.hexdigest()) != sha256:
        raise DependencyError(
            f"{shown} has the SHA-256 {actual}, and the index or the lock says {sha256}: it was "
            "replaced. Nothing of it was kept",
            reason="integrity",
        )


def _opened(url: str) -> IO[bytes]:
    parts = urlsplit(url)
    if parts.scheme == "file" or not parts.scheme:
        path = Path(unquote(parts.path))  # of a folder that the user has named in a setting
        if not path.is_file():
            raise ValueError("it is not a file")
        return path.open("rb")
    if parts.scheme not in ("https", "http"):
        raise ValueError(f"{parts.scheme} is neither https nor http")
    settings = index.environment()
    request = urllib.request.Request(without_login(url), headers={"User-Agent": _USER_AGENT})
    if login := login_for(url):
        # unredirected: a redirect must not carry the login to another host
        request.add_unredirected_header("Authorization", authorization(login))
    context = ssl.create_default_context(cafile=settings.get("SSL_CERT_FILE"))
    lower = {name.lower(): value for name, value in settings.items()}
    named = {
        name: lower.get(f"{name}_proxy") or lower.get("all_proxy") for name in ("http", "https")
    }
    proxies = {name: proxy for name, proxy in named.items() if proxy}
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(proxies),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(context=context),
        urllib.request.HTTPRedirectHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
    ):
        opener.add_handler(handler)
    opened: IO[bytes] = opener.open(request, timeout=_TIMEOUT_S)
    return opened


def login_for(url: str) -> tuple[str, str] | None:
    """Returns the login of the URL, of an index on the same host, or of ``.netrc``."""
    settings = index.environment()
    host = _host(url)
    named = " ".join(settings.get(name, "") for name in _INDEXES).split()
    for place in (url, *(re.sub(r"^[\w-]+=", "", index_url) for index_url in named)):
        if _host(place) == host and (login := login_of(place)):
            return login
    with contextlib.suppress(OSError, netrc.NetrcParseError):
        file = settings.get("NETRC") or os.path.expanduser("~/.netrc")
        if found := netrc.netrc(file).hosts.get(host.partition(":")[0]):
            return found[0], found[2] or ""
    return None


def _host(url: str) -> str:
    return urlsplit(url).netloc.rpartition("@")[2]


def resolve(url: str, revision: str) -> str:
    """Returns the full commit that a revision names now; raises ``DependencyError``."""
    with _as_of_a_package():
        return commits.resolve(url, revision, index.environment())


def check_out(url: str, commit: str, folder: Path, tell: Tell) -> None:
    """Write the files of a commit into an existing, empty folder.

    Skips links and submodules, and names them to ``tell``. Raises ``DependencyError``.
    """
    title = f"{url}@{commit[:12]}"
    with _as_of_a_package(), commits.fetched(url, commit, index.environment()) as found:
        links = [blob.path for blob in found.blobs if blob.is_link]
        for path in (*links, *found.submodules):
            tell(f"{title}: {printable(path, 200)} is a link or a submodule, and is left out")
        files = [
            Member(blob.path, blob.size, blob.executable, partial(found.open, blob))
            for blob in found.blobs
            if not blob.is_link
        ]
        write_tree(files, folder, title)


@contextmanager
def _as_of_a_package() -> Iterator[None]:
    try:
        yield
    except HubReferenceError as error:
        raise DependencyError(str(error), reason="requirement") from error
    except HubFailure as failure:
        raise DependencyError(f"{failure.what}. {failure.advice}", reason="index") from failure
    except SnapshotTooLargeError as error:
        raise DependencyError(str(error), reason="size") from error
    except SnapshotError as error:
        raise DependencyError(str(error)) from error

"""References to git commits: ``git+https://host/org/repo[@revision][:path]``.

Also the short form ``github:org/repo``, or a GitHub page.

``hub.reference`` knows their prefixes.
"""

from __future__ import annotations

import re
from urllib.parse import urlsplit

from envhub_sandbox.hub.grammar import (
    DEFAULT_PATH,
    HUB_HOSTS,
    Parts,
    Wrong,
    check_path,
    check_revision,
    join,
    normal_path,
    parts_of,
)

KIND = "git"
GRAMMAR = "git+https://host/org/repo@commit:path.py, or github:org/repo@commit:path.py"
PROTOCOLS = ("https",)
REVISION = r"(?!.*(?:\.\.|//|@\{))[A-Za-z0-9_][A-Za-z0-9_./+-]{0,200}"
_GITHUB = "github:"
_PAGES = ("https://github.com/", "https://www.github.com/", "github.com/")
_URL = r"([a-z]+)://([A-Za-z0-9][A-Za-z0-9.-]*(?::\d{1,5})?)(/[A-Za-z0-9_.~/+%-]{1,200})"


def is_url(text: str) -> bool:
    """Tells whether git may receive a URL: it contains no option, login or other protocol."""
    match = re.fullmatch(_URL, text)
    return match is not None and match[1] in PROTOCOLS


def read(text: str) -> Parts:
    """Splits a reference, or the URL of a GitHub page, into unchecked parts."""
    text = _of_page(text) if text.lower().startswith(_PAGES) else text
    is_short = text.lower().startswith(_GITHUB)
    rest = text.partition(":" if is_short else "+")[2]
    url = f"https://github.com/{rest.strip('/')}" if is_short else rest
    scheme, separator, rest = url.partition("://")
    host, _, rest = rest.partition("/")
    if not separator or "#" in rest or "?" in rest:
        raise Wrong("an address of git ends with the repository's path", GRAMMAR)
    head, colon, path = rest.partition(":")
    repo, at, revision = head.partition("@")
    address = f"{scheme.lower()}://{host if '@' in host else host.lower()}/{repo.rstrip('/')}"
    path = normal_path(path) if colon else DEFAULT_PATH
    return parts_of(KIND, address, revision if at else None, path)


def _of_page(url: str) -> str:
    steps = urlsplit(f"//{url.partition('://')[2] or url}").path.strip("/").split("/")
    text = _GITHUB + "/".join(steps[:2]).removesuffix(".git")
    page = steps[2:]
    if len(page) < 2 or page[0] not in ("blob", "tree", "commit"):
        return text
    path = "/".join(page[2:])
    return f"{text}@{page[1]}{f':{path}' if path.endswith('.py') else ''}"


def check(parts: Parts) -> None:
    """Raise ``Wrong`` unless git can fetch the reference."""
    scheme, _, rest = parts.repo_id.partition("://")
    host, _, repo = rest.partition("/")
    if "@" in host:
        address = f"'git+{scheme}://{host.rpartition('@')[2]}/{repo}'"
        raise Wrong("the address has a user or token in it, and none is sent", address)
    if scheme not in PROTOCOLS:
        raise Wrong(f"files are not fetched by {scheme[:40]!r}", GRAMMAR)
    if host in HUB_HOSTS:
        raise Wrong("this is a git remote of the Hub", repr(repo.removesuffix(".git") or GRAMMAR))
    too_few = host == "github.com" and not re.fullmatch(r"[^/]+/[^/]+", repo)
    if too_few or not is_url(parts.repo_id) or {"", ".", ".."} & set(repo.split("/")):
        raise Wrong(f"{parts.repo_id[:200]!r} is not the address of a repository", GRAMMAR)
    check_revision(parts)
    if parts.revision is not None and not re.fullmatch(REVISION, parts.revision):
        example = repr(join(parts._replace(revision="main")))
        raise Wrong(
            f"{parts.revision!r} is not a commit, tag or branch of git",
            f"such a one, as in {example}",
        )
    check_path(parts)

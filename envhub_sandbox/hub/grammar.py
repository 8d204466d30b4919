"""The grammar of hub references: the forms that people write, and the checks of their parts.

``read`` reads a plain reference, ``hf://``, and URLs of the Hub's site; ``check`` then checks the
parts. Both raise ``Wrong``, which says what to write instead.
Repository names follow ``huggingface_hub.utils.validate_repo_id``, revisions follow
``git check-ref-format``, and paths are relative, forward and to a ``.py`` file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.platform import IS_WINDOWS

DEFAULT_PATH = "env.py"
REPO_TYPES = ("model", "space", "dataset")
LOCAL_TYPES = FOLDER, FILE = "local", "file"
"""The types of snapshots of this machine: of a folder, or of a file with what it imports."""
GRAMMAR = "owner/name, owner/name@revision, owner/name:path.py or owner/name@revision:path.py"

_COMMIT = re.compile(r"[0-9a-f]{40}")
_NAME = re.compile(r"\b[\w\-.]{1,96}\b", re.ASCII)
_NOT_IN_A_REVISION = re.compile(r"\.\.|@\{|//|/\.|[~^?*\[\\:\s]|\.lock(?:/|$)|^[/.-]|[/.]$")
_TYPE_OF_PREFIX = {prefix: kind for kind in REPO_TYPES for prefix in (kind, f"{kind}s")}
HUB_HOSTS = frozenset({"huggingface.co", "www.huggingface.co", "hf.co", "www.hf.co"})
_FILE_PAGES = frozenset({"tree", "blob", "resolve", "raw"})
_SLASHED_REVISION = re.compile(r"refs/(?:pr|convert|heads|tags)/[^/]+")
_DRIVE = re.compile(r"[A-Za-z]:(?:[\\/]|$)")
_INSIDE = "a path inside the repository, such as 'owner/name:envs/env.py'"


class Parts(NamedTuple):
    """The fields of a reference, not checked yet."""

    repo_id: str
    revision: str | None = None
    path: str = DEFAULT_PATH
    repo_type: str | None = None


class Wrong(Exception):
    """A reference cannot be read; says what is wrong with it, and what to write instead."""

    def __init__(self, reason: str, write: str) -> None:
        super().__init__(reason, write)
        self.what = reason
        self.write = write


def join(parts: Parts) -> str:
    """The canonical text of a reference of any type."""
    if parts.repo_type == "pypi":
        package, _, env_id = parts.repo_id.partition("#")
        return f"pypi:{package}{f'@{parts.revision}' if parts.revision else ''}#{env_id}"
    prefix = f"{parts.repo_type}s/" if parts.repo_type else ""
    prefix = "git+" if parts.repo_type == "git" else prefix
    at = f"@{parts.revision}" if parts.revision is not None else ""
    colon = f":{parts.path}" if parts.path != DEFAULT_PATH else ""
    return f"{prefix}{parts.repo_id}{at}{colon}"


def local_reference(repo_type: str, folder: str, path: str) -> str:
    """The reference of a folder of this machine with its entry file, or of the file alone."""
    return os.path.join(folder, path) if repo_type == FILE else f"{folder}:{path}"


def is_commit(revision: str) -> bool:
    """Whether the revision is a full commit in lower case."""
    return _COMMIT.fullmatch(revision) is not None


def is_local(text: str) -> bool:
    """Whether a reference is local: ``./env``, ``../env``, ``/env``, ``~/env``, ``examples:``."""
    prefixes = ("./", "../", "/", "~/", ".\\", "..\\", "examples:")
    drive = IS_WINDOWS and _DRIVE.match(text) is not None
    return text in (".", "..", "~") or text.startswith(prefixes) or drive


def has_control_characters(text: str) -> bool:
    """Whether the text has a character that moves a terminal's cursor or forges a log line."""
    return not all(c == " " or c.isprintable() for c in text)


def check(parts: Parts) -> None:
    """Raise ``Wrong`` if the Hub cannot have one of the parts."""
    if parts.repo_type is not None and parts.repo_type not in REPO_TYPES:
        raise Wrong(f"there is no repository type {parts.repo_type!r}", " or ".join(REPO_TYPES))
    _check_repo_id(parts)
    check_revision(parts)
    check_path(parts)


def _check_repo_id(parts: Parts) -> None:
    owner, slash, name = parts.repo_id.partition("/")
    if not owner or not name:
        missing = "name" if owner and slash else "owner"
        raise Wrong(f"the repository's {missing} is missing", GRAMMAR)
    if name.endswith(".git"):
        fixed = parts._replace(repo_id=parts.repo_id.removesuffix(".git"))
        raise Wrong("a repository's name does not end in '.git'", repr(join(fixed)))
    for part in (owner, name):
        if not _NAME.fullmatch(part) or "--" in part or ".." in part:
            raise Wrong(
                f"{part!r} is not a valid name on the Hub (letters, digits, '-', '_' and '.', at "
                "most 96, no '--' or '..', neither '-' nor '.' at an end)",
                GRAMMAR,
            )


def check_revision(parts: Parts) -> None:
    """Raise ``Wrong`` if git cannot have such a revision."""
    revision = parts.revision
    if revision is None:
        return
    if not revision:
        raise Wrong("the revision after '@' is empty", repr(join(parts._replace(revision=None))))
    if _NOT_IN_A_REVISION.search(revision) or has_control_characters(revision):
        example = repr(join(parts._replace(revision="main")))
        raise Wrong(
            f"{revision!r} cannot be a revision", f"a branch, tag or commit, as in {example}"
        )


def check_path(parts: Parts) -> None:
    """Raise ``Wrong`` if the path is not a Python file inside of the repository."""
    path = parts.path
    pieces = path.replace("\\", "/").split("/")
    if not path:
        example = parts._replace(path=DEFAULT_PATH)
        raise Wrong("the path after ':' is empty", f"{join(example)!r} (it means ':env.py')")
    if has_control_characters(path):
        raise Wrong("the path has control characters", _INSIDE)
    if _DRIVE.match(path):
        raise Wrong("the path has a drive letter", _INSIDE)
    for bad, complaint in (
        ("\\" in path, "the path has backslashes"),
        (path.startswith("/"), "the path is absolute"),
        (".." in pieces, "the path has '..'"),
        ("." in pieces or "" in pieces[:-1], "the path has empty steps"),
        (any(p != p.strip() for p in pieces), "the path has spaces around a name"),
    ):
        if bad:
            raise Wrong(complaint, _suggest(parts, _inside(pieces)))
    _check_suffix(parts, pieces[-1])


def _check_suffix(parts: Parts, name: str) -> None:
    if name.endswith(".py") and name != ".py":
        return
    before, at, after = parts.path.rpartition("@")
    if at and before.endswith(".py") and parts.revision is None:
        swapped = parts._replace(revision=after, path=before)
        raise Wrong("the revision comes before the path", repr(join(swapped)))
    if "." not in name:
        inside = f"{parts.path.rstrip('/')}/{DEFAULT_PATH}"
        raise Wrong("the path is a folder, not a .py file", _suggest(parts, inside))
    raise Wrong("the path is not a .py file", _suggest(parts, None))


def _suggest(parts: Parts, path: str | None) -> str:
    return repr(join(parts._replace(path=path))) if path else _INSIDE


def _inside(pieces: list[str]) -> str | None:
    """The path without ``..`` and empty steps; None if it leaves the repository or is no .py."""
    kept: list[str] = []
    for piece in (p.strip() for p in pieces):
        if piece == ".." and not kept:
            return None
        if piece == "..":
            kept.pop()
        elif piece not in ("", "."):
            kept.append(piece)
    return "/".join(kept) if kept and kept[-1].endswith(".py") else None


def read(text: str) -> Parts:
    """The parts of a reference in any known form."""
    _refuse_other_texts(text)
    scheme, separator, rest = text.partition("://")
    if separator and re.fullmatch(r"[A-Za-z][A-Za-z0-9+.-]*", scheme):
        reader = _SCHEMES.get(scheme.lower())
        if reader is None:
            raise Wrong(f"'{text.partition(':')[0]}://' does not lead to the Hub", GRAMMAR)
        return reader(text, rest)
    if text.partition("/")[0].lower() in HUB_HOSTS:
        return _read_url("https://" + text, text)
    if text.startswith("git@"):
        raise _git_remote(*text.partition(":")[::2])
    return _read_plain(text)


def _refuse_other_texts(text: str) -> None:
    if not text:
        raise Wrong("it is empty", GRAMMAR)
    if has_control_characters(text):
        raise Wrong("it has control characters", GRAMMAR)
    if is_local(text):
        raise Wrong(
            "this is a folder of this machine, not a repository",
            f"{GRAMMAR}, or give the folder itself to make_env or envhub run",
        )
    if _DRIVE.match(text):
        raise Wrong("this is a path with a drive letter", GRAMMAR)


def _read_plain(text: str) -> Parts:
    """Read ``[type/]owner/name[@revision][:path]``; an ``@`` after the colon is in the path."""
    head, colon, path = text.partition(":")
    repo, at, revision = head.partition("@")
    kind, repo_id = _split_repo(repo, text[len(repo) :])
    path = normal_path(path) if colon else DEFAULT_PATH
    return parts_of(kind, repo_id, revision if at else None, path)


def parts_of(kind: str | None, repo_id: str, revision: str | None, path: str) -> Parts:
    """Make the parts; a commit becomes lower case."""
    if revision is not None and is_commit(revision.lower()):
        revision = revision.lower()
    return Parts(repo_id, revision, path, kind)


def normal_path(path: str) -> str:
    """Normalise ``./a//b.py`` to ``a/b.py``; paths that ``check_path`` refuses stay unchanged."""
    if path.startswith("/") or "\\" in path:
        return path
    kept = "/".join(step for step in path.split("/") if step not in ("", "."))
    return f"{kept}/" if kept and path.endswith("/") else kept or path


def _split_repo(repo: str, rest: str) -> tuple[str | None, str]:
    """Split ``[type/]owner/name``; ``rest``: the text after it, for suggestions in errors."""
    steps = repo.split("/")
    kind, prefix = None, ""
    if len(steps) > 1 and steps[0] in _TYPE_OF_PREFIX:
        kind, prefix = _TYPE_OF_PREFIX[steps[0]], f"{steps[0]}/"
        steps = steps[1:]
    if len(steps) == 1 and steps[0]:
        if not prefix and re.search(r"#.|-v\d+\Z", repo + rest):
            package, _, env_id = (repo + rest).rpartition("#")
            package = package.rpartition(":")[2] or "PACKAGE"
            example = f"pypi:{package}#{env_id}"
            raise Wrong("this names an environment of Gymnasium, not a repository", repr(example))
        if not prefix and not rest and repo.endswith(".py"):
            reason = "this is the name of a file, which does not exist here"
            raise Wrong(reason, f"'./FOLDER/{repo}' or 'OWNER/NAME:{repo}'")
        local = "" if prefix or rest else f" (or './{repo}' for a local folder)"
        example = f"{prefix}OWNER/{steps[0]}{rest}"
        raise Wrong("the owner is missing", f"{example!r} with the owner's name{local}")
    if len(steps) > 2:
        if "" in steps or rest:
            raise Wrong("a repository is owner/name, with one slash", GRAMMAR)
        path = "/".join(steps[2:])
        path = path if path.endswith(".py") else f"{path}/{DEFAULT_PATH}"
        cure = f"{prefix}{'/'.join(steps[:2])}:{path}"
        raise Wrong("the path comes after a colon", repr(cure))
    return kind, "/".join(steps)


def _read_hf(text: str, rest: str) -> Parts:
    """Read ``hf://[type/]owner/name[@revision][/path]``, also with ``:path``."""
    if ":" in rest:
        return _read_plain(rest)
    steps = rest.strip("/").split("/")
    lead = 3 if steps[0] in _TYPE_OF_PREFIX else 2
    repo, at, revision = "/".join(steps[:lead]).partition("@")
    kind, repo_id = _split_repo(repo, rest[len(repo) :])
    if not at:
        return _with_path(kind, repo_id, None, steps[lead:])
    return _with_path(kind, repo_id, *_split_revision([revision, *steps[lead:]]))


def _split_revision(steps: list[str]) -> tuple[str, list[str]]:
    """Split off a revision: one step (slashes percent-encoded), or a ref such as ``refs/pr/3``."""
    slashed = _SLASHED_REVISION.match("/".join(steps))
    if slashed is not None:
        return unquote(slashed.group()), steps[3:]
    return unquote(steps[0]), steps[1:]


def _with_path(kind: str | None, repo_id: str, revision: str | None, steps: list[str]) -> Parts:
    path = unquote("/".join(step for step in steps if step))
    return parts_of(kind, repo_id, revision, normal_path(path) or DEFAULT_PATH)


def _read_url(url: str, _: str) -> Parts:
    try:
        split = urlsplit(url)
    except ValueError:
        raise Wrong("this URL cannot be read", GRAMMAR) from None
    if "@" in split.netloc:
        plain = f"{split.scheme}://{split.netloc.rpartition('@')[2]}{split.path}"
        raise Wrong(
            "the URL has a user or token in it", f"{plain!r}, and pass {option_name('token')}"
        )
    steps = [step for step in split.path.split("/") if step]
    if split.netloc.lower() not in HUB_HOSTS:
        repo = "/".join(steps[:2]) or "owner/name"
        endpoint = f"{split.scheme}://{split.netloc}"
        mirror = f"{repo!r}, with {option_name('endpoint', endpoint)} if that mirrors the Hub"
        raise Wrong("this host is not the Hugging Face Hub", mirror)
    return _read_page(steps)


def _read_page(steps: list[str]) -> Parts:
    """Read the path of a URL: ``[type/]owner/name``, and the page of a commit or of a file."""
    lead = 3 if steps and steps[0] in _TYPE_OF_PREFIX else 2
    repo = "/".join(steps[:lead]).removesuffix(".git")
    if len(steps) < lead:
        raise Wrong("the URL names no repository", GRAMMAR)
    kind, repo_id = _split_repo(repo, "")
    page, rest = "".join(steps[lead : lead + 1]), steps[lead + 1 :]
    if not page or (page in _FILE_PAGES and not rest):
        return parts_of(kind, repo_id, None, DEFAULT_PATH)
    if page in _FILE_PAGES:
        return _with_path(kind, repo_id, *_split_revision(rest))
    if page in ("commit", "commits") and rest:
        return parts_of(kind, repo_id, _split_revision(rest)[0], DEFAULT_PATH)
    parts = Parts(repo_id, repo_type=kind)
    write = repr(join(parts))
    if page == "discussions" and rest and rest[0].isdigit():
        pull_request = join(parts._replace(revision=f"refs/pr/{rest[0]}"))
        write += f", or {pull_request!r} for the pull request"
    raise Wrong(f"the page {page!r} of a repository is not a file", write)


def _read_git(_: str, rest: str) -> Parts:
    raise _git_remote(*rest.partition("/")[::2])


def _git_remote(remote: str, path: str) -> Wrong:
    repo, host = path.removesuffix(".git").strip("/"), remote.rpartition("@")[2].lower()
    elsewhere = "github:" if host == "github.com" else f"git+https://{host}/"
    write = repo if host in HUB_HOSTS else elsewhere + repo
    return Wrong("this is a git remote", repr(write) if repo else GRAMMAR)


_SCHEMES: dict[str, Callable[[str, str], Parts]] = {
    "hf": _read_hf,
    "http": _read_url,
    "https": _read_url,
    "ssh": _read_git,
    "git": _read_git,
    "git+ssh": _read_git,
}

"""What a hub reference may be made of. Raises ``Wrong``, which says what to write instead.

Repository names follow ``huggingface_hub.utils.validate_repo_id``, revisions follow
``git check-ref-format``, and paths are relative, forward and to a ``.py`` file.
"""

from __future__ import annotations

import re
from typing import NamedTuple

DEFAULT_PATH = "env.py"
REPO_TYPES = ("model", "space", "dataset")
GRAMMAR = "owner/name, owner/name@revision, owner/name:path.py or owner/name@revision:path.py"

_COMMIT = re.compile(r"[0-9a-f]{40}")
_NAME = re.compile(r"\b[\w\-.]{1,96}\b", re.ASCII)
_NOT_IN_A_REVISION = re.compile(r"\.\.|@\{|//|/\.|[~^?*\[\\:\s]|\.lock(?:/|$)|^[/.-]|[/.]$")
_INSIDE = "a path inside the repository, such as 'owner/name:envs/env.py'"


class Parts(NamedTuple):
    """The fields of a reference, before anybody has looked at them."""

    repo_id: str
    revision: str | None = None
    path: str = DEFAULT_PATH
    repo_type: str | None = None


class Wrong(Exception):
    """A reference cannot be read: what is wrong with it, and what to write instead."""

    def __init__(self, what: str, write: str) -> None:
        super().__init__(what, write)
        self.what = what
        self.write = write


def join(parts: Parts) -> str:
    """The canonical text of a reference."""
    prefix = f"{parts.repo_type}s/" if parts.repo_type else ""
    at = f"@{parts.revision}" if parts.revision is not None else ""
    colon = f":{parts.path}" if parts.path != DEFAULT_PATH else ""
    return f"{prefix}{parts.repo_id}{at}{colon}"


def is_commit(revision: str) -> bool:
    """Whether the revision is a full commit in lower case."""
    return _COMMIT.fullmatch(revision) is not None


def is_local(text: str) -> bool:
    """Whether the text names a folder here: ``./env``, ``../env``, ``/abs/env``, ``~/env``."""
    return text in (".", "..", "~") or text.startswith(("./", "../", "/", "~/", ".\\", "..\\"))


def has_control_characters(text: str) -> bool:
    """Whether anything in the text would move a terminal's cursor or forge a log line."""
    return not all(c == " " or c.isprintable() for c in text)


def check(parts: Parts) -> None:
    """Raise ``Wrong`` unless the Hub could have every part."""
    if parts.repo_type is not None and parts.repo_type not in REPO_TYPES:
        raise Wrong(f"there is no repository type {parts.repo_type!r}", " or ".join(REPO_TYPES))
    _check_repo_id(parts)
    _check_revision(parts)
    _check_path(parts)


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
                f"{part!r} cannot be a name on the Hub (letters, digits, '-', '_' and '.', at "
                "most 96, no '--' or '..', neither '-' nor '.' at an end)",
                GRAMMAR,
            )


def _check_revision(parts: Parts) -> None:
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


def _check_path(parts: Parts) -> None:
    path = parts.path
    pieces = path.replace("\\", "/").split("/")
    if not path:
        example = parts._replace(path=DEFAULT_PATH)
        raise Wrong("the path after ':' is empty", f"{join(example)!r} (it means ':env.py')")
    if has_control_characters(path):
        raise Wrong("the path has control characters", _INSIDE)
    if re.match(r"[A-Za-z]:(?:[\\/]|$)", path):
        raise Wrong("the path has a drive letter", _INSIDE)
    _check_steps(parts, pieces)
    _check_suffix(parts, pieces[-1])


def _check_steps(parts: Parts, pieces: list[str]) -> None:
    for bad, what in (
        ("\\" in parts.path, "the path has backslashes"),
        (parts.path.startswith("/"), "the path is absolute"),
        (".." in pieces, "the path has '..'"),
        ("." in pieces or "" in pieces[:-1], "the path has empty steps"),
        (any(p != p.strip() for p in pieces), "the path has spaces around a name"),
    ):
        if bad:
            raise Wrong(what, _suggest(parts, _inside(pieces)))


def _check_suffix(parts: Parts, name: str) -> None:
    if name.endswith(".py") and name != ".py":
        return
    before, at, after = parts.path.rpartition("@")
    if at and before.endswith(".py") and parts.revision is None:
        swapped = parts._replace(revision=after, path=before)
        raise Wrong("the revision stands behind the path", repr(join(swapped)))
    if "." not in name:
        inside = f"{parts.path.rstrip('/')}/{DEFAULT_PATH}"
        raise Wrong("the path is a folder, not a .py file", _suggest(parts, inside))
    raise Wrong("the path is not a .py file", _suggest(parts, None))


def _suggest(parts: Parts, path: str | None) -> str:
    return repr(join(parts._replace(path=path))) if path else _INSIDE


def _inside(pieces: list[str]) -> str | None:
    """The path without ``..`` and empty steps; None if it climbs out or ends in no file."""
    kept: list[str] = []
    for piece in (p.strip() for p in pieces):
        if piece == ".." and not kept:
            return None
        if piece == "..":
            kept.pop()
        elif piece not in ("", "."):
            kept.append(piece)
    return "/".join(kept) if kept and kept[-1].endswith(".py") else None

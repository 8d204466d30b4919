"""What git would commit of a folder, asked of git without obeying the checkout.

A checkout may be a stranger's. Its ``.git`` names programs that git runs (``core.fsmonitor``,
filters, hooks), the folder that git looks at (``core.worktree``), and where git fetches missing
objects from. So git gets a repository folder of our own, ``folder``, with no such settings. Of
the checkout's it reads data alone: the index, the objects and ``info/exclude``; and in the folder
``.gitignore`` and ``.gitattributes``. The caller's own settings hold, as for any ``git``.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.system.log import SNAPSHOT
from envhub_sandbox.system.platform import user_id
from envhub_worker.protocol.records import dataclass

TIMEOUT_S = 20.0
"""For git: a hostile pattern in ``.gitignore`` can take for ever."""
_MOST_BYTES = 64 << 10
"""Of a file that is read here rather than by git."""
_GIT_FOLDER = Path(__file__).with_name("git_folder")
_SETTINGS = ("core.fsmonitor=false", "core.untrackedCache=false", f"core.hooksPath={os.devnull}")
_KEPT = ("GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM", "GIT_CONFIG_NOSYSTEM")
_LIST = ("ls-files", "-z", "-v", "--cached", "--others", "--exclude-standard")
_CONVERSIONS = ("filter", "ident", "working-tree-encoding")
"""Attributes by which a folder has other bytes than the commit; ends of lines aside."""
_SHA256 = r"(?im)^\s*objectformat\s*=\s*\"?sha256"
"""In a configuration; such an index reads as another one here, and git does not notice."""


class _Repository(NamedTuple):
    """Where a checkout begins, its git folder, and the one that it shares with its worktrees."""

    top: Path
    own: Path
    common: Path
    is_sha256: bool


@dataclass(frozen=True)
class Checkout:
    """A folder that lies in a git checkout.

    Attributes:
        files: What a commit of everything would hold of it, relative to it; among them folders
            that are repositories of their own, of which it would hold a pointer.
        folders: Every folder above these.
        untracked: The files of which it would be the first commit.
        held_back: Files of which a commit has git's own version, whatever lies in the folder
            (skip-worktree, assume-unchanged).
    """

    folder: Path
    files: frozenset[str]
    folders: frozenset[str]
    untracked: frozenset[str]
    held_back: tuple[str, ...]
    _repository: _Repository

    @cached_property
    def tracked(self) -> frozenset[str]:
        """The files that git knows already."""
        return self.files - self.untracked

    def tracks_below(self, folder: str) -> bool:
        """Whether git knows a file in a folder."""
        return any(name.startswith(f"{folder}/") for name in self.tracked)

    def names_in(self, folder: str) -> frozenset[str]:
        """What the files in a folder are called."""
        return self._names.get(folder, frozenset())

    @cached_property
    def _names(self) -> dict[str, frozenset[str]]:
        names_by_value: dict[str, set[str]] = {}
        for path in self.files:
            folder, _, name = path.rpartition("/")
            names_by_value.setdefault(folder, set()).add(name)
        return {folder: frozenset(names) for folder, names in names_by_value.items()}

    def converted(self, names: Iterable[str]) -> list[tuple[str, str]]:
        """Which of these files git commits with other bytes, and by which attribute.

        ``.gitattributes`` counts as it lies in the folder, and as it lies in the index: by the
        latter git made the folder, and it may have converted ``.gitattributes``, too. Raises
        ``SnapshotError`` where git cannot say.
        """
        paths = b"".join(os.fsencode(name) + b"\0" for name in names)
        return sorted({*self._attributes(paths), *self._attributes(paths, "--cached")})

    def _attributes(self, paths: bytes, *source: str) -> Iterator[tuple[str, str]]:
        command = ("check-attr", "-z", "--stdin", *source, *_CONVERSIONS)
        output = _git(self._repository, self.folder, *command, given=paths)
        if output is None:
            raise SnapshotError(
                f"local folder {self.folder}: git cannot read its .gitattributes. Mend or remove "
                "that file"
            )
        words = [os.fsdecode(word) for word in output.split(b"\0")[:-1]]
        for name, attribute, value in zip(*(words[first::3] for first in range(3)), strict=True):
            if value not in ("unspecified", "unset", "lfs"):
                yield name, f"{attribute}={value}"


def read_checkout(folder: Path) -> Checkout | None:
    """What git says of a folder (an absolute path without links); None where it is in no checkout,
    or git cannot tell. Raises ``SnapshotError`` where a pattern keeps git from it: a commit can
    have one, and would hide by it what ``converted`` finds.

    Git runs no program and writes nothing. A folder that the checkout around it ignores as a whole
    is in none. A ``.git`` counts only where it belongs to root, to us or to the folder's owner: in
    ``/tmp`` every user of the machine can make one.
    """
    repository = _repository_of(folder)
    if repository is None or repository.is_sha256:
        return None
    # what the checkout's user has git ignore, beside what the commit says
    exclude = repository.common / "info/exclude"
    excluding = [f"--exclude-from={exclude}"] if exclude.is_file() else []
    output = _git(repository, folder, *_LIST, *excluding)
    rows = [os.fsdecode(row) for row in (output or b"").split(b"\0")[:-1] if row[2:] != b"./"]
    if output is None or not (rows or folder == repository.top):
        return None
    names = frozenset(row[2:].rstrip("/") for row in rows)
    above = (name.split("/")[:-1] for name in names)
    folders = frozenset("/".join(steps[: n + 1]) for steps in above for n in range(len(steps)))
    held_back = tuple(sorted({row[2:] for row in rows if row[0] == "S" or row[0].islower()}))
    untracked = frozenset(row[2:] for row in rows if row[0] == "?")
    return Checkout(folder, names, folders, untracked, held_back, repository)


def is_unread(folder: Path) -> bool:
    """Whether a folder lies in a checkout of which git says nothing: so nobody knows what its
    commit has. There is no git, it fails, or the object ids are SHA-256.
    """
    repository = _repository_of(folder)
    if repository is None:
        return False
    return repository.is_sha256 or _git(repository, folder, "ls-files", "-z", "--cached") is None


def make_checkout(folder: Path) -> None:
    """Run ``git init`` in a folder that is in no checkout, where there is git."""
    program = _program()
    if program is None or read_checkout(folder.resolve()) is not None:
        return
    command = [program, "init", "--quiet", os.fspath(folder)]
    subprocess.run(command, env=_environment(None), capture_output=True, check=False)


def top_of(folder: Path) -> Path | None:
    """The folder, or the nearest one above it, that has a ``.git`` of any kind."""
    around = (folder, *folder.parents)
    return next((folder for folder in around if os.path.lexists(folder / ".git")), None)


def _repository_of(folder: Path) -> _Repository | None:
    top = top_of(folder)
    if top is None:
        return None
    try:
        own = top / ".git"
        if own.is_file():
            kind, _, path = _text_of(own).partition(":")
            own = top / path.strip() if kind == "gitdir" else own
        common = own / _text_of(own / "commondir").strip()
        is_one = (own / "HEAD").is_file() and (common / "objects").is_dir()
        is_sha256 = re.search(_SHA256, _text_of(common / "config")) is not None
        owners = (folder.stat().st_uid, user_id(), 0)
        is_trusted = (top / ".git").lstat().st_uid in owners
    except (OSError, ValueError):  # also a path with a null byte
        return None
    return _Repository(top, own, common, is_sha256) if is_one and is_trusted else None


def _text_of(file: Path) -> str:
    if not file.is_file():
        return ""
    with file.open("rb") as stream:
        return os.fsdecode(stream.read(_MOST_BYTES))


def _git(
    repository: _Repository, folder: Path, *arguments: str, given: bytes = b""
) -> bytes | None:
    """What git says; None where there is no git, or it fails. Raises ``SnapshotError``: it takes
    too long.
    """
    program = _program()
    if program is None:
        return None
    settings = [word for setting in _SETTINGS for word in ("-c", setting)]
    try:
        done = subprocess.run(
            [program, *settings, *arguments],
            input=given,
            capture_output=True,
            cwd=folder,
            env=_environment(repository),
            timeout=TIMEOUT_S,
            check=True,
        )
    except subprocess.TimeoutExpired as error:
        raise SnapshotError(
            f"local folder {folder}: git cannot read its .gitattributes and .gitignore in "
            f"{TIMEOUT_S:g} s. Mend or remove these files"
        ) from error
    except (OSError, subprocess.SubprocessError) as error:
        printed = getattr(error, "stderr", None) or b""
        SNAPSHOT.warning("git cannot read the checkout %s: %s %r", folder, error, printed[-300:])
        return None
    return done.stdout


def _program() -> str | None:
    path = shutil.which("git")
    # with "." on the PATH it could be a file of the folder
    return path if path is not None and os.path.isabs(path) else None


def _environment(repository: _Repository | None) -> dict[str, str]:
    """The caller's variables, without those by which a hook of git's names its repository."""
    kept = (name for name in os.environ if name in _KEPT or not name.startswith("GIT_"))
    ours = {name: os.environ[name] for name in kept}
    if repository is None:
        return ours
    return {
        **ours,
        "GIT_DIR": os.fspath(_GIT_FOLDER),
        "GIT_WORK_TREE": os.fspath(repository.top),
        "GIT_INDEX_FILE": os.fspath(repository.own / "index"),
        "GIT_OBJECT_DIRECTORY": os.fspath(repository.common / "objects"),
        "GIT_OPTIONAL_LOCKS": "0",
        "GIT_NO_LAZY_FETCH": "1",
    }

"""Asks git which files of a folder it would commit, without obeying the checkout.

Trust: a checkout may be a stranger's. Its ``.git`` names programs for git (``core.fsmonitor``,
filters, hooks), the folder that git examines (``core.worktree``), and sources of missing objects.
So git gets our own repository folder, ``folder``, without these settings. From the checkout it
reads only data: the index, the objects and ``info/exclude``; and from the folder ``.gitignore``
and ``.gitattributes``. The caller's own settings apply, as for any ``git``.
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
"""The time limit of git: a hostile pattern in ``.gitignore`` can take for ever."""
_MOST_BYTES = 1 << 20
"""The largest file that this module reads itself."""
_GIT_FOLDER = Path(__file__).with_name("git_folder")
_SETTINGS = ("core.fsmonitor=false", "core.untrackedCache=false", f"core.hooksPath={os.devnull}")
_KEPT = ("GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM", "GIT_CONFIG_NOSYSTEM")
_LIST = ("ls-files", "-z", "-v", "--cached", "--others", "--exclude-standard")
_CONVERSIONS = ("filter", "ident", "working-tree-encoding")
"""Attributes that make a folder's bytes differ from the commit's, apart from line ends."""
_KEY = r"(?im)(?:^|\])[ \t]*{}[ \t]*=[ \t]*\"?"
"""Where a line of git's configuration sets a key; no blank line is read twice."""
_OTHER_IDS = r"(?im)objectformat[ \t]*=(?![ \t]*sha1[ \t]*\r?$)"
"""Marks other ids than SHA-1 in git's configuration, however it is spelled: the key stands there as
it is. Git would misread such an index without an error.
"""

_MODELESS = _KEY.format("filemode") + r"(false|no|off|0)\b"
"""Marks a checkout, as of Windows, whose index says which files are executable."""


class _Repository(NamedTuple):
    """A checkout's top folder, its git folder, and the git folder that its worktrees share."""

    top: Path
    own: Path
    common: Path
    has_other_ids: bool
    is_modeless: bool


@dataclass(frozen=True)
class Checkout:
    """A folder in a git checkout.

    Attributes:
        files: The paths that a commit of everything would contain, relative to the folder; for a
            nested repository the path of its folder, since the commit contains a pointer to it.
        folders: Every folder above these.
        untracked: The files that git does not know yet.
        held_back: Files whose own version git commits, whatever the folder contains
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
        """Returns the files that git knows already."""
        return self.files - self.untracked

    @cached_property
    def programs(self) -> frozenset[str] | None:
        """Returns the executable files of the index; None if those of the folder count."""
        if not self._repository.is_modeless:
            return None
        output = _git(self._repository, self.folder, "ls-files", "-z", "--stage") or b""
        rows = (row for row in output.split(b"\0") if row.startswith(b"100755"))
        return frozenset(os.fsdecode(row.partition(b"\t")[2]) for row in rows)

    def tracks_below(self, folder: str) -> bool:
        """Tells whether git knows a file below a folder."""
        return any(name.startswith(f"{folder}/") for name in self.tracked)

    def names_in(self, folder: str) -> frozenset[str]:
        """Returns the names of the files in a folder."""
        return self._names.get(folder, frozenset())

    @cached_property
    def _names(self) -> dict[str, frozenset[str]]:
        names_by_value: dict[str, set[str]] = {}
        for path in self.files:
            folder, _, name = path.rpartition("/")
            names_by_value.setdefault(folder, set()).add(name)
        return {folder: frozenset(names) for folder, names in names_by_value.items()}

    def converted(self, names: Iterable[str]) -> list[tuple[str, str]]:
        """Returns the files that git commits with other bytes, each with the responsible attribute.

        Reads ``.gitattributes`` from folder and index: git made the folder by the index's version,
        and may have converted ``.gitattributes`` too. Raises ``SnapshotError`` if git fails.
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
    """Asks git about a folder (an absolute path without links); None if it is in no checkout or
    git fails. Raises ``SnapshotError`` if a pattern makes git too slow: a commit could
    contain such a pattern to hide the files that ``converted`` finds.

    Git runs no program and writes nothing. A folder that the surrounding checkout ignores is in no
    checkout. A ``.git`` counts only if root, this user or the folder's owner owns it: in ``/tmp``
    every user of the machine can make one.
    """
    repository = _repository_of(folder)
    if repository is None or repository.has_other_ids:
        return None
    # patterns that the checkout's user ignores, beside those of the commit
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
    """Tells whether a folder lies in a checkout that git cannot read, so that its commit is
    unknown: git is missing or fails, or the object ids are not SHA-1.
    """
    repository = _repository_of(folder)
    if repository is None:
        return False
    return (
        repository.has_other_ids or _git(repository, folder, "ls-files", "-z", "--cached") is None
    )


def make_checkout(folder: Path) -> None:
    """Run ``git init`` in a folder outside any checkout, if git is installed."""
    program = _program()
    if program is None or read_checkout(folder.resolve()) is not None:
        return
    command = [program, "init", "--quiet", os.fspath(folder)]
    subprocess.run(command, env=_environment(None), capture_output=True, check=False)


def top_of(folder: Path) -> Path | None:
    """Returns the nearest folder, from this one upwards, that has a ``.git`` of any kind."""
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
        config = _text_of(common / "config")
        is_cut = len(os.fsencode(config)) == _MOST_BYTES
        marks = [is_cut or re.search(mark, config) is not None for mark in (_OTHER_IDS, _MODELESS)]
        owners = (folder.stat().st_uid, user_id(), 0)
        is_trusted = (top / ".git").lstat().st_uid in owners
    except (OSError, ValueError):  # also for a path with a null byte
        return None
    return _Repository(top, own, common, *marks) if is_one and is_trusted else None


def _text_of(file: Path) -> str:
    if not file.is_file():
        return ""
    with file.open("rb") as stream:
        return os.fsdecode(stream.read(_MOST_BYTES))


def _git(
    repository: _Repository, folder: Path, *arguments: str, given: bytes = b""
) -> bytes | None:
    """Returns git's output; None if git is missing or fails. Raises ``SnapshotError``: it takes too
    long.
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
    # with "." on PATH, git could be a file of the folder
    return path if path is not None and os.path.isabs(path) else None


def _environment(repository: _Repository | None) -> dict[str, str]:
    """Returns the caller's variables, without those that a git hook sets to name its repository."""
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

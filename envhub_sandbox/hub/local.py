"""Snapshots of a folder or a file of this machine, so that authors can try before they push.

In a git checkout the snapshot has the files that git would commit, and a link is a file with the
link's text. Elsewhere it has every file of the folder. A link inside the folder is replaced by its
target, and a link that leaves the folder is refused, since the jail must see nothing but the
folder. ``.git``, sockets and pipes are always left out.

The snapshot of a file has the files of its folder that it needs (``sources.own``), and those that
git tracks. Unrelated files may lie beside it, so no link is followed, and no file that looks like
keys is taken.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import posixpath
import stat
from collections.abc import Callable, Collection, Iterator
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, Protocol

from envhub_sandbox.errors import (
    PolicyError,
    RepositoryUnavailableError,
    SnapshotError,
    SnapshotTooLargeError,
)
from envhub_sandbox.hub.grammar import DEFAULT_PATH, FILE, FOLDER, local_reference
from envhub_sandbox.hub.listing import (
    DEFAULT_LIMITS,
    MAX_DEPTH,
    SHA256,
    FileRecord,
    HashMismatch,
    Snapshot,
    check_listing_names,
    copy_verified,
    digest_of,
    listing_within_limits,
)
from envhub_sandbox.hub.secrets import is_home, looks_secret
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import extras
from envhub_sandbox.system.log import warn_caller
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import counted, first_of

_GIT = ".git"
_EXAMPLES = "examples:"
_ALL_COUNTS = (
    "It is not in a git checkout, so every file in it is included. Move away what does not belong "
    "to the repository, or run 'git init' there and name it in .gitignore"
)
_SHOWN = 5
_REQUIREMENTS = "requirements.txt"
IGNORED, REPOSITORY = "ignored by git", "a git repository of its own"
_VENV, _UNREADABLE, _SECRET = "a virtual environment", "unreadable", "keys"
_LINK, _DEAD_LINK = "a link", "a link to nothing"
_CURES = {
    IGNORED: "Run 'git add --force {path}', or take it out of .gitignore",
    REPOSITORY: "Name that folder alone",
    _VENV: "Move it out of there",
    _UNREADABLE: "Give yourself permission to read it",
    _LINK: "Put a copy in its place",
    _DEAD_LINK: "Put a file in its place",
    _SECRET: "Name the folder, with {allow}",
}
"""The reasons why a file is left out of a snapshot, each with advice on how to include it."""


class Checkout(Protocol):
    """The files of a folder that git would commit: see the extra ``sources.checkout``."""

    @property
    def files(self) -> frozenset[str]:
        """The files and nested repositories that a commit of everything would have."""

    @property
    def folders(self) -> frozenset[str]:
        """Every folder that contains one of these."""

    @property
    def tracked(self) -> frozenset[str]:
        """The files that git tracks already."""

    @property
    def programs(self) -> frozenset[str] | None:
        """The executable files, if git does not look at the modes of the folder."""

    def tracks_below(self, folder: str) -> bool:
        """Whether git tracks a file in a folder."""


class LocalFile(NamedTuple):
    """A file of a folder: its name in the snapshot, its path on this machine, its size, and whether
    it is executable; for a link that git would commit, also the link's text, its content.
    """

    path: str
    source: Path
    size: int
    executable: bool = False
    link: bytes | None = None

    @classmethod
    def at(cls, path: str, source: Path) -> LocalFile:
        """Describe a regular file."""
        status = source.stat(follow_symlinks=False)
        return cls(path, source, status.st_size, bool(status.st_mode & stat.S_IXUSR))


class LeftOut(NamedTuple):
    """A file or folder (with a slash at its end) that is not in the snapshot, and why."""

    path: str
    why: str


class Listing(NamedTuple):
    """The sorted files of a snapshot, their records, and the files that were left out."""

    files: tuple[LocalFile, ...]
    records: tuple[FileRecord, ...]
    left_out: tuple[LeftOut, ...]


@dataclass(frozen=True)
class LocalFolder:
    """A folder of this machine, by a path without links; without a checkout, every file is in the
    snapshot.
    ``entry``: the file, if a file was named; the snapshot then has what this file's code may see.
    """

    root: Path
    checkout: Checkout | None
    entry: str | None = None

    def __str__(self) -> str:
        if self.entry is None:
            return f"local folder {self.root}"
        return f"local file {self.root / self.entry}"

    @classmethod
    def at(cls, folder: str | Path, entry: str | None = None) -> LocalFolder:
        """The folder at a path, or with ``entry`` its part that this file may see."""
        root = Path(os.path.realpath(folder))
        read_checkout = extras.find("envhub_sandbox.extras.sources.checkout", "read_checkout")
        # if the file is in a home directory, git's files there, if any, are not the file's
        is_own = entry is not None and is_home(root)
        return cls(root, None if is_own or read_checkout is None else read_checkout(root), entry)

    @classmethod
    def of(cls, snapshot: Snapshot) -> LocalFolder:
        """The folder or file that a snapshot is a copy of."""
        entry = snapshot.path if snapshot.repo_type == FILE else None
        return cls.at(snapshot.repo_id, entry)

    def files(self) -> Iterator[LocalFile]:
        """The files of the snapshot, with ``/`` in their names. A link that leaves the folder is
        refused.
        """
        return (item for item in self._found() if isinstance(item, LocalFile))

    def listed(self, *, allow_secrets: bool = False) -> Listing:
        """List and read the files of the snapshot, within limits; returns them with records.
        Raises ``SnapshotError``: they cannot be read; ``PolicyError``: it is a folder with keys, or
        a home.
        """
        # The order matters. A home directory is refused before it is listed, since it may have
        # millions of files. Names are checked for keys before any content is read, so that no key
        # is read unless the caller allows it. Then all files are hashed.
        left: list[LeftOut] = []
        if self.entry is None and not allow_secrets and is_home(self.root):
            raise self._secret("is a home directory, or has one in it")
        try:
            listing = listing_within_limits(self._kept(left), DEFAULT_LIMITS, str(self))
        except OSError as error:
            raise SnapshotError(f"{self}: it cannot be read: {error}") from error
        except SnapshotTooLargeError as error:
            if self.checkout is None:
                error.args = (f"{error}. {_ALL_COUNTS}",)
            raise
        secret = [file.path for file in listing if self.entry is None and looks_secret(file.path)]
        if secret and not allow_secrets:
            raise self._secret(f"holds what looks like keys or passwords: {_shown(secret)}")
        records = tuple(
            FileRecord(file.path, file.size, _digest(file, str(self)), file.executable)
            for file in listing
        )
        check_listing_names(records, str(self))
        return Listing(listing, records, tuple(left))

    def _secret(self, reason: str) -> PolicyError:
        ignore = ", have git ignore it" if self.checkout else ""
        return PolicyError(
            f"{self} {reason}. The code would see all of it. Move away what it should not see"
            f"{ignore}, or name the .py file alone, as {self.root / 'env.py'}, whose code sees of "
            "its folder only what it imports. If it may see everything here, pass "
            f"{option_name('allow_secrets', True)}"
        )

    def _kept(self, left: list[LeftOut]) -> Iterator[LocalFile]:
        for item in self._found():
            if isinstance(item, LocalFile):
                yield item
            elif not _is_empty_folder(self.root / item.path):
                left.append(item)

    def seen(self, listing: Listing) -> str:
        """One line about the files that the code can see."""
        names = [item.path for item in listing.files]
        summary = f"{self}: the code sees {counted(len(names), 'file')} of "
        summary += "it" if self.entry is None else f"its folder: {_shown(names)}"
        left = [item for item in listing.left_out if item.why not in (IGNORED, REPOSITORY)]
        if left:
            summary += f"; left out: {_shown([f'{item.path} ({item.why})' for item in left])}"
        return summary

    def warn_of_requirements(self, listing: Listing) -> None:
        """Warn if a requirements.txt beside a file is not used: other packages, other results."""
        beside = self.root / _REQUIREMENTS
        if self.entry is None or not beside.is_file():
            return
        if any(file.path == _REQUIREMENTS for file in listing.files):
            return
        warn_caller(
            f"{self.root / self.entry} is named alone, so {beside} does not say which packages it "
            f"gets. Name the folder, {self.as_folder()}, or declare them in the file itself",
        )

    def as_folder(self) -> str:
        """The reference of a file's whole folder."""
        return repr(local_reference(FOLDER, str(self.root), str(self.entry)))

    def advice(self, path: str) -> str:
        """Advice on how to show the code a file that exists in the folder."""
        if self.entry is not None:
            return (
                f"{path!r} is there, in {self.root}, but a file that is named alone shows the code "
                "only what it imports, and what git tracks. To show it the whole folder, name that "
                f"with its entry: {self.as_folder()}"
            )
        otherwise = f"has {path!r} now", "Make the environment again"
        reason, cure = self.why_left_out(path) or otherwise
        return f"{self} {reason}. {cure}"

    def why_left_out(self, path: str) -> tuple[str, str] | None:
        """Why an existing file is not in the snapshot, and advice; None if it was not left out."""
        for item in self.left_out():
            if f"{path}/".startswith(f"{item.path.rstrip('/')}/"):
                allow = option_name("allow_secrets", True)
                reason = f"has the file {path!r}, but left it out: {item.path} is {item.why}"
                return reason, _CURES[item.why].format(path=path, allow=allow)
        return None

    def left_out(self) -> Iterator[LeftOut]:
        """Yield files and folders that are not in the snapshot, except empty folders."""
        items = (item for item in self._found() if isinstance(item, LeftOut))
        return (item for item in items if not _is_empty_folder(self.root / item.path))

    def _found(self) -> Iterator[LocalFile | LeftOut]:
        if self.entry is not None:
            items = self._of_the_file(self.entry)
            return (
                LeftOut(item.path, _SECRET) if looks_secret(item.path) else item for item in items
            )
        if self.checkout is None:
            return self._all(self.root, "", (self.root,))
        return self._committed(self.checkout, self.root, "")

    def _of_the_file(self, entry: str) -> Iterator[LocalFile | LeftOut]:
        own_files = extras.required(
            "envhub_sandbox.extras.sources.own", "own_files", str(self), "name its folder"
        )
        own = own_files(self.root, entry, self.checkout)
        if self.checkout is None:
            for name in sorted(own):
                yield from self._one(self.root / name, name, (self.root,))
            return
        folders = tuple(name for name in own if name.endswith("/"))
        for item in self._committed(self.checkout, self.root, ""):
            is_tracked = item.path in self.checkout.tracked
            if is_tracked or item.path in own or item.path.startswith(folders):
                yield item

    def _committed(
        self, checkout: Checkout, folder: Path, prefix: str
    ) -> Iterator[LocalFile | LeftOut]:
        for item in self._items(folder, prefix):
            name, path = prefix + item.name, Path(item.path)
            mode = item.stat(follow_symlinks=False).st_mode
            if stat.S_ISDIR(mode) and name not in checkout.folders:
                is_repository = name in checkout.files
                yield LeftOut(f"{name}/", REPOSITORY if is_repository else IGNORED)
            elif stat.S_ISDIR(mode) and _is_venv(path) and not checkout.tracks_below(name):
                yield LeftOut(f"{name}/", _VENV)
            elif stat.S_ISDIR(mode):
                yield from self._committed(checkout, path, f"{name}/")
            elif not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
                continue  # git ignores sockets, pipes and devices
            elif name not in checkout.files:
                yield LeftOut(name, IGNORED)
            elif stat.S_ISLNK(mode):
                text = os.fsencode(os.readlink(path))
                yield LocalFile(name, path, len(text), link=text)
            elif name in checkout.tracked or os.access(path, os.R_OK):
                file, programs = LocalFile.at(name, path), checkout.programs
                if programs is not None and name in checkout.tracked:
                    file = file._replace(executable=name in programs)
                yield file
            else:  # a tracked file is never left out, since a commit has it
                yield LeftOut(name, _UNREADABLE)

    def _all(
        self, folder: Path, prefix: str, above: tuple[Path, ...]
    ) -> Iterator[LocalFile | LeftOut]:
        for item in self._items(folder, prefix):
            yield from self._one(Path(item.path), prefix + item.name, above)

    def _one(self, path: Path, name: str, above: tuple[Path, ...]) -> Iterator[LocalFile | LeftOut]:
        name = name.rstrip("/")
        if path.is_symlink() and self.entry not in (None, name):
            yield LeftOut(name, _LINK)
            return
        if path.is_symlink() and not os.path.exists(os.path.realpath(path)):
            yield LeftOut(name, _DEAD_LINK)  # some editors lock files by dead links
            return
        source = self._inside(path, name)
        if source.is_dir() and _is_venv(source):
            yield LeftOut(f"{name}/", _VENV)
        elif source.is_dir() and not os.access(source, os.R_OK | os.X_OK):
            yield LeftOut(f"{name}/", _UNREADABLE)
        elif source.is_dir():
            if source in above:
                raise SnapshotError(f"{self}: the link {name!r} leads to a loop")
            yield from self._all(source, f"{name}/", (*above, source))
        elif source.is_file() and os.access(source, os.R_OK):
            yield LocalFile.at(name, source)
        elif source.is_file():
            yield LeftOut(name, _UNREADABLE)

    def _items(self, folder: Path, prefix: str) -> list[os.DirEntry[str]]:
        if prefix.count("/") >= MAX_DEPTH:
            raise SnapshotError(f"{self}: {prefix!r} is over {MAX_DEPTH} folders deep")
        with os.scandir(folder) as listing:
            return sorted((item for item in listing if item.name != _GIT), key=attrgetter("name"))

    def _inside(self, path: Path, name: str) -> Path:
        if not path.is_symlink():
            return path
        source = Path(os.path.realpath(path))
        if not source.is_relative_to(self.root) or _GIT in source.relative_to(self.root).parts:
            raise SnapshotError(
                f"{self}: the link {name!r} points outside the folder (to {source}), where a "
                "sandbox cannot read; put a copy in its place"
            )
        return source


def _shown(names: Collection[str]) -> str:
    return ", ".join(first_of(sorted(names), _SHOWN))


def _is_venv(folder: Path) -> bool:
    """Whether a folder is a virtual environment that was made here. Its interpreter is a link or a
    Windows program, unlike in a copy from a commit.
    """
    program, other = folder / "bin/python", folder / "Scripts/python.exe"
    is_made = os.path.islink(program) or os.path.isfile(other)  # these never raise
    return is_made and os.path.isfile(folder / "pyvenv.cfg")


def _is_empty_folder(path: Path) -> bool:
    try:
        return path.is_dir() and not os.listdir(path)
    except OSError:
        return False  # an unreadable folder may have files


class LocalPath(NamedTuple):
    """A local reference: the folder, the entry file, and whether only the file was named."""

    folder: Path
    path: str
    is_file: bool = False

    def listed(self, *, allow_secrets: bool = False) -> tuple[LocalFolder, Listing]:
        """The folder and the files that its code may see; raises as ``LocalFolder.listed``."""
        folder = LocalFolder.at(self.folder, self.path if self.is_file else None)
        return folder, folder.listed(allow_secrets=allow_secrets)

    @property
    def repo_type(self) -> str:
        """The type of its snapshot."""
        return FILE if self.is_file else FOLDER


def split_local(text: str) -> LocalPath:
    """Read a local reference: ``./env``, ``./env:sub/env.py``, ``./x/other.py``, ``examples:x``."""
    if text.startswith(_EXAMPLES):
        text = str(_example(text))
    folder = Path(os.path.abspath(os.path.expanduser(text)))
    if folder.is_dir():
        return LocalPath(folder, DEFAULT_PATH)
    if folder.is_file():
        if folder.suffix != ".py":
            raise RepositoryUnavailableError(
                f"local file {text!r}: an entry is a .py file, or a folder with an env.py"
            )
        return LocalPath(folder.parent, folder.name, is_file=True)
    before, colon, after = text.rpartition(":")
    if colon and before and after:
        inner = Path(os.path.abspath(os.path.expanduser(before)))
        if inner.is_dir():  # on Windows the path may be written with backslashes
            return LocalPath(inner, posixpath.normpath(after.replace(os.sep, "/")))
    raise RepositoryUnavailableError(
        f"local folder {text!r}: there is no such folder or file here (looked for {folder}). "
        "Write './folder', './folder:path/env.py' or './folder/env.py'; a repository of the Hub "
        f"is owner/name{_similar(folder)}"
    )


def _similar(path: Path) -> str:
    """A question that suggests an existing path of a similar name; or empty."""
    import difflib

    with contextlib.suppress(OSError):
        names = [
            item.name for item in path.parent.iterdir() if item.suffix == ".py" or item.is_dir()
        ]
        close = difflib.get_close_matches(path.name, names, n=1)
        return f". Did you mean {str(path.parent / close[0])!r}?" if close else ""
    return ""


def _example(text: str) -> Path:
    """The folder of an example, in this checkout or where the wheel has installed it."""
    checkout = Path(__file__).resolve().parents[2]
    import sysconfig  # rarely needed, and slow to import

    schemes = ("data", sysconfig.get_default_scheme()), ("data", "posix_user")
    installed = [checkout / "share"] + [
        Path(sysconfig.get_path(*scheme), "share") for scheme in schemes
    ]
    roots = [checkout] if (checkout / "worker" / "envhub_worker").is_dir() else []
    roots += [share / "envhub-sandbox" for share in installed]
    examples = next((path for root in roots if (path := root / "examples").is_dir()), None)
    names = sorted(path.parent.name for path in examples.glob("*/env.py")) if examples else []
    name = text.removeprefix(_EXAMPLES)
    if examples is None or name not in names:
        raise RepositoryUnavailableError(
            f"{text!r}: there is no such example; choose one: "
            + (", ".join(f"{_EXAMPLES}{example}" for example in names) or "none is installed")
        )
    return examples / name


def _digest(file: LocalFile, title: str) -> str:
    if file.link is not None:
        return f"{SHA256}:{hashlib.sha256(file.link).hexdigest()}"
    try:
        return digest_of(file.source, SHA256, file.size)
    except (OSError, HashMismatch) as error:
        raise SnapshotError(f"{title}: {file.path!r} cannot be read: {error}") from error


def copier(files: tuple[LocalFile, ...], title: str) -> Callable[[FileRecord, Path], None]:
    """A function that copies one file into the store; it raises if the file has changed."""
    by_path = {file.path: file for file in files}

    def copy(record: FileRecord, target: Path) -> None:
        file = by_path[record.path]
        if file.link is not None:
            target.write_bytes(file.link)
            return
        try:
            copy_verified(file.source, target, record)
        except HashMismatch as error:
            raise SnapshotError(
                f"{title}: {record.path!r} changed while it was copied; try again"
            ) from error

    return copy

"""A folder of this machine as the files of a snapshot, so that authors can try before they push.

In a git checkout these are the files that git would commit, as it would commit them: a link is a
file that holds the link's text. Elsewhere it is every file; links that stay inside the folder are
copied as what they point to, and a link that leaves it is refused, since the jail must see nothing
but the folder. ``.git`` is in no commit, and left out everywhere, as are sockets and pipes.
"""

from __future__ import annotations

import hashlib
import os
import posixpath
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from envhub_sandbox.errors import (
    RepositoryUnavailableError,
    SnapshotError,
    SnapshotTooLargeError,
)
from envhub_sandbox.hub.git.checkout import Checkout, read_checkout
from envhub_sandbox.hub.grammar import DEFAULT_PATH
from envhub_sandbox.hub.listing import (
    DEFAULT_LIMITS,
    MAX_DEPTH,
    SHA256,
    FileRecord,
    HashMismatch,
    check_listing_names,
    copy_verified,
    digest_of,
    listing_within_limits,
)
from envhub_worker.protocol.records import dataclass

_GIT = ".git"
_EXAMPLES = "examples:"
_ALL_COUNTS = (
    "It is not in a git checkout, so every file in it is included. Move away what does not belong "
    "to the repository, or run 'git init' there and name it in .gitignore"
)


class LocalFile(NamedTuple):
    """A file of a folder: its name in the snapshot, where its bytes are, and its size; or the text
    of a link that git would commit, which is then its content.
    """

    path: str
    source: Path
    size: int
    link: bytes | None = None


class LeftOut(NamedTuple):
    """What lies in a checkout and is in no commit of it; a folder has a slash at its end. It is
    ignored, or a repository of its own, of which git commits a pointer.
    """

    path: str
    is_repository: bool


@dataclass(frozen=True)
class LocalFolder:
    """A folder of this machine, without links in its path; every file counts where git says nothing
    of it.
    """

    root: Path
    checkout: Checkout | None

    def __str__(self) -> str:
        return f"local folder {self.root}"

    @classmethod
    def at(cls, folder: str | Path) -> LocalFolder:
        """The folder at a path."""
        root = Path(os.path.realpath(folder))
        return cls(root, read_checkout(root))

    def files(self) -> Iterator[LocalFile]:
        """The files of the snapshot, with ``/`` in their names. A link that leaves the folder is
        refused.
        """
        return (one for one in self._found() if isinstance(one, LocalFile))

    def listed(self) -> tuple[tuple[LocalFile, ...], tuple[FileRecord, ...]]:
        """The files of the snapshot, within limits, and their records, by reading all of them."""
        try:
            found = listing_within_limits(self.files(), DEFAULT_LIMITS, str(self))
        except OSError as error:
            raise SnapshotError(f"{self}: it cannot be read: {error}") from error
        except SnapshotTooLargeError as error:
            if self.checkout is None:
                error.args = (f"{error}. {_ALL_COUNTS}",)
            raise
        records = tuple(FileRecord(one.path, one.size, _digest(one, str(self))) for one in found)
        check_listing_names(records, str(self))
        return found, records

    def why_left_out(self, path: str) -> tuple[str, str] | None:
        """What to say of a file that is there, and that git would not commit."""
        for one in self.left_out():
            if f"{path}/".startswith(f"{one.path.rstrip('/')}/"):
                what = f"has the file {path!r}, but git would not commit it"
                if one.is_repository:
                    return what, f"{one.path} is a separate git repository; name that one"
                return what, f"Run 'git add --force {path}', or take it out of .gitignore"
        return None

    def left_out(self) -> Iterator[LeftOut]:
        """Yield what lies here and is not in the snapshot; empty folders aside."""
        found = (one for one in self._found() if isinstance(one, LeftOut))
        return (one for one in found if not _is_empty_folder(self.root / one.path))

    def _found(self) -> Iterator[LocalFile | LeftOut]:
        if self.checkout is None:
            return self._all(self.root, "", (self.root,))
        return self._committed(self.checkout, self.root, "")

    def _committed(
        self, checkout: Checkout, folder: Path, prefix: str
    ) -> Iterator[LocalFile | LeftOut]:
        for item in self._items(folder, prefix):
            name, path = prefix + item.name, Path(item.path)
            mode = item.stat(follow_symlinks=False).st_mode
            if stat.S_ISDIR(mode) and name in checkout.folders:
                yield from self._committed(checkout, path, f"{name}/")
            elif stat.S_ISDIR(mode):
                yield LeftOut(f"{name}/", is_repository=name in checkout.files)
            elif not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
                continue  # git knows no sockets, pipes and devices
            elif name not in checkout.files:
                yield LeftOut(name, is_repository=False)
            elif stat.S_ISLNK(mode):
                if name in checkout.untracked:
                    self._refuse_environment(path, name)
                text = os.fsencode(os.readlink(path))
                yield LocalFile(name, path, len(text), text)
            else:
                yield LocalFile(name, path, item.stat(follow_symlinks=False).st_size)

    def _all(self, folder: Path, prefix: str, above: tuple[Path, ...]) -> Iterator[LocalFile]:
        for item in self._items(folder, prefix):
            name = prefix + item.name
            source = self._inside(item, name)
            if source.is_dir():
                if source in above:
                    raise SnapshotError(f"{self}: the link {name!r} leads to a loop")
                yield from self._all(source, f"{name}/", (*above, source))
            elif source.is_file():
                yield LocalFile(name, source, source.stat().st_size)

    def _items(self, folder: Path, prefix: str) -> list[os.DirEntry[str]]:
        if prefix.count("/") >= MAX_DEPTH:
            raise SnapshotError(f"{self}: {prefix!r} is over {MAX_DEPTH} folders deep")
        with os.scandir(folder) as listing:
            return sorted((one for one in listing if one.name != _GIT), key=lambda one: one.name)

    def _inside(self, item: os.DirEntry[str], name: str) -> Path:
        if not item.is_symlink():
            return Path(item.path)
        try:
            source = Path(os.path.realpath(item.path, strict=True))
        except OSError as error:
            raise SnapshotError(f"{self}: the link {name!r} points nowhere; remove it") from error
        if not source.is_relative_to(self.root) or _GIT in source.relative_to(self.root).parts:
            self._refuse_environment(Path(item.path), name)
            raise SnapshotError(
                f"{self}: the link {name!r} points outside the folder (to {source}), where a "
                "sandbox cannot read; put a copy in its place"
            )
        return source

    def _refuse_environment(self, link: Path, name: str) -> None:
        """A virtual environment is no part of a repository, and has links to its interpreter."""
        inside = (one for one in link.parents if one.is_relative_to(self.root))
        found = next((one for one in inside if (one / "pyvenv.cfg").is_file()), None)
        if found is not None:
            raise SnapshotError(
                f"{self}: {name!r} belongs to a virtual environment. Move {found} elsewhere, or "
                f"have git ignore it: name '{found.name}/' in .gitignore, after 'git init' if this "
                "is not a checkout yet"
            )


def _is_empty_folder(path: Path) -> bool:
    try:
        return path.is_dir() and not os.listdir(path)
    except OSError:
        return False  # what may not be read may hold anything


def split_local(text: str) -> tuple[Path, str]:
    """The folder and entry of ``./env``, ``./env:sub/env.py``, ``./x/other.py``, ``examples:x``."""
    if text.startswith(_EXAMPLES):
        text = str(_example(text))
    folder = Path(os.path.abspath(os.path.expanduser(text)))
    if folder.is_dir():
        return folder, DEFAULT_PATH
    if folder.is_file():
        if folder.suffix != ".py":
            raise RepositoryUnavailableError(
                f"local file {text!r}: an entry is a .py file, or a folder with an env.py"
            )
        return folder.parent, folder.name
    before, colon, after = text.rpartition(":")
    if colon and before and after:
        inner = Path(os.path.abspath(os.path.expanduser(before)))
        if inner.is_dir():  # on Windows the path may be written with backslashes
            return inner, posixpath.normpath(after.replace(os.sep, "/"))
    raise RepositoryUnavailableError(
        f"local folder {text!r}: there is no such folder or file here (looked for {folder}). "
        "Write './folder', './folder:path/env.py' or './folder/env.py'; a repository of the Hub "
        "is owner/name"
    )


def _example(text: str) -> Path:
    """The folder of an example: in the checkout that this is, or where the wheel has put it."""
    checkout = Path(__file__).resolve().parents[2]
    import sysconfig  # rarely needed, and slow to import

    schemes = ("data", sysconfig.get_default_scheme()), ("data", "posix_user")
    installed = [checkout / "share"] + [Path(sysconfig.get_path(*one), "share") for one in schemes]
    roots = [checkout] if (checkout / "worker" / "envhub_worker").is_dir() else []
    roots += [share / "envhub-sandbox" for share in installed]
    examples = next((one for root in roots if (one := root / "examples").is_dir()), None)
    known = sorted(one.parent.name for one in examples.glob("*/env.py")) if examples else []
    name = text.removeprefix(_EXAMPLES)
    if examples is None or name not in known:
        raise RepositoryUnavailableError(
            f"{text!r}: there is no such example; choose one: "
            + (", ".join(f"{_EXAMPLES}{one}" for one in known) or "none is installed")
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
    """A function that copies one file into the store, or says that it changed meanwhile."""
    found = {file.path: file for file in files}

    def copy(record: FileRecord, target: Path) -> None:
        file = found[record.path]
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

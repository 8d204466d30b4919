"""Reads the files of a git commit as data; ``GitHost`` has the Hub's interface.

Git gets only our settings: no hooks, filters, submodules or logins, and no protocol but https.
Nothing is checked out: this module reads files from git's objects, whose names are hashes of their
content, so a full commit identifies all of them. Snapshots and packages' sources both use it.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

from envhub_sandbox.errors import (
    HubReferenceError,
    SnapshotError,
    SnapshotIntegrityError,
    SnapshotTooLargeError,
)
from envhub_sandbox.extras.sources import git_address as address
from envhub_sandbox.hub.answers import HubFailure, Kind
from envhub_sandbox.hub.grammar import is_commit
from envhub_sandbox.hub.listing import (
    GIT_SHA1,
    CommitFiles,
    Copier,
    FileRecord,
    HashMismatch,
    Repository,
    write_verified,
)
from envhub_sandbox.system.log import SNAPSHOT
from envhub_sandbox.system.platform import IS_LINUX, kill_group, own_group, own_variables
from envhub_worker.protocol.text import first_of, printable, size_text

if sys.platform != "win32":
    import resource


MAX_BYTES = 2 * 2**30
"""Bytes of a file that git writes: a fetched pack, or all unpacked files of a commit."""
MAX_FILES = 50_000
_MAX_ROW_BYTES = 2048
"""Bytes of a row in git's listing: git bounds no path, and each path repeats its folders."""
TIMEOUT_S = 900.0
"""The time for all of git's work on one commit."""
DAY_S = 30.0
"""The time for the day of a commit, for which an error message waits."""
_BLOCK = 1 << 20
_SAID_BYTES = 1000
_ROW = re.compile(rb"(\d{6}) (\w+) ([0-9a-f]{40}) +(\d+|-)\t(.+)", re.DOTALL)
_SETTINGS = (
    *("protocol.allow=never", f"core.hooksPath={os.devnull}", "credential.helper="),
    *("core.fsmonitor=false", "submodule.recurse=false", "transfer.bundleURI=false"),
    *("gc.auto=0", "maintenance.auto=false", "core.askPass=true"),
)
_LIMITED = 'ulimit -f "$1" && ulimit -v "$2" && shift 2 && exec "$@"'
"""The first commands of ``sh``: git's children inherit the limits. Windows has none."""
_MEMORY_KIB = 4 * 2**20
_ALONE = {
    "GIT_TERMINAL_PROMPT": "0",
    "GIT_NO_LAZY_FETCH": "1",
    "GIT_CEILING_DIRECTORIES": "/",
    "TZ": "UTC0",
}


Variables = Mapping[str, str]
"""The user's variables: git receives those for access to the network."""


def resolve(url: str, revision: str, variables: Variables | None = None) -> str:
    """Returns the full commit that a branch or a tag names now; sends no query for a full commit.

    Raises ``HubReferenceError`` for an unsupported URL or name, and ``HubFailure``.
    """
    if is_commit(revision):
        return revision
    if not re.fullmatch(address.REVISION, revision):
        raise HubReferenceError(
            f"{revision[:200]!r} is not a commit, tag or branch of {url[:200]!r}"
        )
    names = [f"refs/tags/{revision}^{{}}", f"refs/tags/{revision}", f"refs/heads/{revision}"]
    names = ["HEAD"] if revision == "HEAD" else names
    with tempfile.TemporaryDirectory(prefix="envhub-git-") as folder:
        git = _Git(Path(folder), variables)
        answer = git.run("ls-remote", "--quiet", _checked(url), *names)
    rows = answer.decode("utf-8", "replace").splitlines()  # other names may have the same end
    commits = {name: commit for commit, _, name in (row.partition("\t") for row in rows)}
    commit = next((commits[name] for name in names if name in commits), "")
    if not is_commit(commit):
        failure = f"{url} has no tag or branch {revision!r}"
        raise HubFailure(Kind.NO_REVISION, failure, "Write all 40 digits of a commit")
    return commit


@dataclass(frozen=True)
class GitBlob:
    """A file of a commit: its path, the name of its object, its size and its kind."""

    path: str
    digest: str
    size: int
    executable: bool
    is_link: bool


class GitFiles:
    """The content of a commit, while it is on this machine.
    ``blobs``: its files, and its links, whose content is their target.
    ``submodules``: the paths of submodules, which are not fetched.
    """

    def __init__(self, blobs: list[GitBlob], submodules: list[str], content: IO[bytes]) -> None:
        self.blobs = blobs
        self.submodules = submodules
        self._content = content
        self._starts: dict[str, int] = {}
        end = 0
        for blob in blobs:  # a line of ``cat-file --batch`` precedes each blob
            start = end + len(f"{blob.digest} blob {blob.size}\n")
            self._starts[blob.path] = start
            end = start + blob.size + 1

    def open(self, blob: GitBlob) -> IO[bytes]:
        """Returns a stream of a blob's bytes; use one stream at a time."""
        return io.BufferedReader(_Part(self._content, self._starts[blob.path], blob.size))


class _Part(io.RawIOBase):
    """A part of a file, read in blocks: a stranger chose its size."""

    def __init__(self, file: IO[bytes], start: int, size: int) -> None:
        self._file = file
        self._at = start
        self._end = start + size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        self._file.seek(self._at)
        data = self._file.read(min(len(buffer), self._end - self._at))
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


@contextmanager
def fetched(url: str, commit: str, variables: Variables | None = None) -> Iterator[GitFiles]:
    """Yields the files of a full commit, valid inside the context.

    Raises as ``resolve``, and ``SnapshotTooLargeError`` or ``SnapshotError`` for the content.
    """
    source = _checked(url)
    title = f"{url}@{commit[:12]}"
    with tempfile.TemporaryDirectory(prefix="envhub-git-") as folder:
        store = Path(folder)
        git = _Git(store, variables)
        git.fetch(source, commit)
        submodules: list[str] = []
        with (store / "rows").open("w+b") as file:
            git.run("ls-tree", "-r", "-z", "-l", "--full-tree", commit, output=file)
            file.seek(0)
            blobs = list(_blobs(_rows(file, title), title, submodules))
        size = sum(blob.size for blob in blobs)
        if size > MAX_BYTES:
            raise SnapshotTooLargeError(f"{title} has {size_text(size)} of files; that is too much")
        with (store / "blobs").open("w+b") as file:
            names = "".join(f"{blob.digest}\n" for blob in blobs)
            git.run("cat-file", "--batch", given=names.encode(), output=file)
            yield GitFiles(blobs, submodules, file)


def day_of(url: str, commit: str) -> str:
    """Returns the day on which a full commit was made: ``"2024-05-31"``. Raises as ``resolve``."""
    with tempfile.TemporaryDirectory(prefix="envhub-git-") as folder:
        git = _Git(Path(folder), None, DAY_S)
        git.fetch(_checked(url), commit, "--filter=tree:0")  # without files, where a host can
        # in UTC, as _ALONE says: an index dates its files so
        words = ("log", "-1", "--no-patch", "--date=format-local:%Y-%m-%d", "--format=%cd", commit)
        return git.run(*words).decode().strip()


def _rows(file: IO[bytes], title: str) -> Iterator[bytes]:
    """Yields each file of a tree, bounded: nested trees expand a few bytes to billions of files."""
    left = b""
    count = 0
    while block := file.read(_BLOCK):
        *rows, left = (left + block).split(b"\0")
        count += len(rows)
        if count > MAX_FILES:
            raise SnapshotTooLargeError(f"{title} has more than {MAX_FILES} files")
        if any(len(row) > _MAX_ROW_BYTES for row in (*rows, left)):
            raise SnapshotTooLargeError(f"{title} has a file with a name that is too long")
        yield from rows


def _blobs(rows: Iterable[bytes], title: str, submodules: list[str]) -> Iterator[GitBlob]:
    for row in rows:
        match = _ROW.fullmatch(row)
        if match is None:
            raise SnapshotError(f"{title}: git lists {row[:200]!r}")
        mode, kind, digest, size, name = match.groups()
        path = os.fsdecode(name)
        if kind == b"blob":
            executable, is_link = mode == b"100755", mode == b"120000"
            yield GitBlob(path, digest.decode(), int(size), executable, is_link)
        else:
            submodules.append(path)


def _checked(url: str) -> str:
    if not address.is_url(url):
        raise HubReferenceError(
            f"{printable(url, 200)!r} is not a supported address: git+https://, a host and a path, "
            "without a login"
        )
    return url


class _Git:
    """Runs git in one folder, within one deadline, without the user's settings and logins."""

    def __init__(
        self, store: Path, variables: Variables | None, timeout_s: float | None = None
    ) -> None:
        self._store = store
        self._timeout_s = TIMEOUT_S if timeout_s is None else timeout_s
        self._until = time.monotonic() + self._timeout_s
        ours = {"GIT_CONFIG_NOSYSTEM": "1", "GIT_CONFIG_GLOBAL": os.devnull, "HOME": str(store)}
        theirs = os.environ if variables is None else variables
        kept = own_variables() | {
            name: value
            for name, value in theirs.items()
            if name in ("PATH", "LANG") or name.lower().endswith("_proxy")
        }
        if certificates := theirs.get("SSL_CERT_FILE"):
            kept["GIT_SSL_CAINFO"] = os.path.abspath(os.path.expanduser(certificates))
        self._environment = {**kept, **ours, **_ALONE}

    def fetch(self, source: str, commit: str, *options: str) -> None:
        """Fetch one commit into the folder, which becomes a repository."""
        self.run("init", "--quiet", "--bare", "--template=", ".")
        plain = ("--quiet", "--depth=1", "--no-tags", "--no-recurse-submodules", "--no-auto-gc")
        self.run("fetch", *plain, *options, source, commit)

    def run(self, *arguments: str, given: bytes = b"", output: IO[bytes] | None = None) -> bytes:
        """Runs git; returns the beginning of its output, or writes the output to a file.

        Git prints into files, whose size the kernel limits: a pipe would bring all of it into our
        memory.
        """
        program = shutil.which("git")
        if program is None:
            failure = "a git repository has to be downloaded, and git is not installed"
            raise HubFailure(Kind.OTHER, failure, "Install it, as in 'apt-get install git'")
        settings = [*_SETTINGS, *(f"protocol.{name}.allow=always" for name in address.PROTOCOLS)]
        command = [program, *(word for setting in settings for word in ("-c", setting)), *arguments]
        store = self._store
        with tempfile.TemporaryFile(dir=store) as said, tempfile.TemporaryFile(dir=store) as kept:
            try:
                self._run_to_its_end(
                    [*_limited(), *command], given, stdout=output or kept, stderr=said
                )
            except (OSError, subprocess.SubprocessError) as error:
                late = isinstance(error, subprocess.TimeoutExpired)
                why = f"it took longer than {self._timeout_s:.0f} s" if late else str(error)
                said.seek(max(0, said.seek(0, os.SEEK_END) - _SAID_BYTES))
                text = said.read(_SAID_BYTES).decode("utf-8", "replace") or why
                failure = f"git {arguments[0]} failed: {printable(text, _SAID_BYTES).strip()}"
                advice = "Check the address, the commit and the network"
                raise HubFailure(Kind.UNREACHABLE, failure, advice) from error
            kept.seek(0)
            return kept.read(_BLOCK)

    def _run_to_its_end(
        self, words: list[str], given: bytes, stdout: IO[bytes], stderr: IO[bytes]
    ) -> None:
        """Run a command; leave no process of it, even after a timeout or an interrupt.

        Git's children contact the host, which may never answer them.
        """
        with subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=stdout,
            stderr=stderr,
            cwd=self._store,
            env=self._environment,
            **own_group(),
        ) as process:
            try:
                process.communicate(given, max(self._until - time.monotonic(), 0))
            finally:
                kill_group(process)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, "git")


def _limited() -> tuple[str, ...]:
    """Returns a command's prefix for its limits: files in 512-byte blocks, memory in KiB."""
    words: tuple[str, ...] = ()
    if sys.platform != "win32":
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        file_bytes = MAX_BYTES if most == resource.RLIM_INFINITY else min(MAX_BYTES, most)
        memory = str(_MEMORY_KIB) if IS_LINUX else "unlimited"  # macOS knows no such limit
        words = "/bin/sh", "-c", _LIMITED, "sh", str(file_bytes // 512), memory
    return words


_LOOKED_AT = 64 << 10
_SHOWN = 10


@dataclass(frozen=True)
class GitHost:
    """A git host: ``public_endpoint`` is the scheme and host before the repository's name."""

    public_endpoint: str

    def resolve(self, repo: Repository, revision: str | None) -> str:
        """Returns the full commit that a branch or a tag names now; None means ``HEAD``."""
        return resolve(f"{self.public_endpoint}/{repo.repo_id}", revision or "HEAD")

    @contextmanager
    def files(self, repo: Repository, commit: str) -> Iterator[CommitFiles]:
        """Yields a commit's files. A link is a file with its target as text; skips submodules."""
        with fetched(f"{self.public_endpoint}/{repo.repo_id}", commit) as found:
            title = f"{repo.repo_id}@{commit[:12]}"
            if found.submodules:
                shown = ", ".join(first_of(list(map(repr, found.submodules)), _SHOWN))
                SNAPSHOT.warning("%s: submodules are left out: %s", title, shown)
            if _has_lfs(found):
                SNAPSHOT.warning("%s: of its files in LFS only the pointers are here", title)
            records = (
                FileRecord(blob.path, blob.size, f"{GIT_SHA1}:{blob.digest}", blob.executable)
                for blob in found.blobs
            )
            yield CommitFiles(records, partial(_copier, found))


def _has_lfs(found: GitFiles) -> bool:
    """Tells whether the root's ``.gitattributes`` uses LFS."""
    for blob in found.blobs:
        if blob.path == ".gitattributes":
            with found.open(blob) as stream:
                return b"filter=lfs" in stream.read(_LOOKED_AT)
    return False


def _copier(found: GitFiles, files: Sequence[FileRecord], title: str) -> Copier:
    blobs = {blob.path: blob for blob in found.blobs}

    def copy(record: FileRecord, target: Path) -> None:
        try:
            with found.open(blobs[record.path]) as stream:
                write_verified(stream, target, record)
        except HashMismatch as mismatch:
            raise SnapshotIntegrityError(
                f"{title}: git returned {mismatch.found} as {record.path!r}, which is "
                f"{record.digest}. Nothing of it was used; try again, with another git"
            ) from mismatch

    return copy

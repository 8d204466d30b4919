"""Fetches the files of one commit of a git repository, as data.

Git gets no settings but ours: no hooks, no filters, no submodules, no logins, and no protocol but
https. Nothing is checked out: files are read out of the objects, whose names are hashes of their
content, so that a full commit names all of them.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

from envhub_sandbox.dependencies import index
from envhub_sandbox.dependencies.builds.trees import MAX_BYTES, MAX_FILES, Member, write_tree
from envhub_sandbox.errors import (
    DependencyError,
    IndexUnavailableError,
    PackagesTooLargeError,
    RequirementError,
)
from envhub_worker.protocol.text import printable

PROTOCOLS = ("https",)
_COMMIT = re.compile(r"[0-9a-f]{40}")
_NAME = re.compile(r"(?!.*(?:\.\.|//|@\{))[A-Za-z0-9_][A-Za-z0-9_./+-]{0,200}")
_URL = re.compile(r"([a-z]+)://([A-Za-z0-9][A-Za-z0-9.-]*(?::\d+)?)(/[A-Za-z0-9_.~/+%-]+)")
_TIMEOUT_S = 900.0
_BLOCK = 1 << 20
_SAID_BYTES = 1000
_ROW = re.compile(rb"(\d{6}) (\w+) ([0-9a-f]{40}) +(\d+|-)\t(.+)", re.DOTALL)
_SETTINGS = (
    *("protocol.allow=never", f"core.hooksPath={os.devnull}", "credential.helper="),
    *("core.fsmonitor=false", "submodule.recurse=false", "transfer.bundleURI=false"),
    *("gc.auto=0", "maintenance.auto=false", "core.askPass=true"),
)
_LIMITED = 'ulimit -f "$1" && ulimit -v "$2" && shift 2 && exec "$@"'
"""What ``sh`` does first: git's own children have the same limits."""
_MEMORY_KIB = 4 * 2**20
_ALONE = {"GIT_TERMINAL_PROMPT": "0", "GIT_NO_LAZY_FETCH": "1", "GIT_CEILING_DIRECTORIES": "/"}


def resolve(url: str, revision: str) -> str:
    """The full commit that a branch or a tag means now; one that is full is not asked for.

    Raises:
        RequirementError: The URL or the name is none that is taken.
        IndexUnavailableError: The host does not answer, or has no such name.
    """
    if _COMMIT.fullmatch(revision):
        return revision
    if not _NAME.fullmatch(revision):
        raise RequirementError(f"{revision[:200]!r} is no commit, tag or branch of {url[:200]!r}")
    names = [f"refs/tags/{revision}^{{}}", f"refs/tags/{revision}", f"refs/heads/{revision}"]
    names = ["HEAD"] if revision == "HEAD" else names
    with tempfile.TemporaryDirectory(prefix="envhub-git-") as nowhere:
        said = _git(Path(nowhere), "ls-remote", "--quiet", _checked(url), *names).decode()
    found = {name: commit for commit, _, name in (x.partition("\t") for x in said.splitlines())}
    commit = next((found[name] for name in names if name in found), "")
    if not _COMMIT.fullmatch(commit):
        raise IndexUnavailableError(
            f"{url} has no tag or branch {revision!r}. Of a commit write all 40 digits"
        )
    return commit


def check_out(url: str, commit: str, folder: Path, tell: Callable[[str], None]) -> None:
    """Write the files of a commit below a folder that is there and empty.

    Links and submodules are left out, and named to ``tell``.
    """
    address = _checked(url)
    with tempfile.TemporaryDirectory(prefix="envhub-git-") as place:
        store = Path(place)
        _git(store, "init", "--quiet", "--bare", "--template=", ".")
        options = ("--quiet", "--depth=1", "--no-tags", "--no-recurse-submodules", "--no-auto-gc")
        _git(store, "fetch", *options, address, commit)
        title = f"{url}@{commit[:12]}"
        with (store / "rows").open("w+b") as file:
            _git(store, "ls-tree", "-r", "-z", "-l", "--full-tree", commit, output=file)
            file.seek(0)
            blobs = list(_blobs(_rows(file, title), title, tell))
        with (store / "blobs").open("w+b") as file:
            names = "".join(f"{blob.digest}\n" for blob in blobs)
            _git(store, "cat-file", "--batch", given=names.encode(), output=file)
            write_tree(_members(blobs, file), folder, title)


class _Blob(NamedTuple):
    path: str
    digest: str
    size: int
    executable: bool


def _rows(file: IO[bytes], title: str) -> Iterator[bytes]:
    """Each file of a tree. Trees that hold each other make billions of a few bytes."""
    left = b""
    count = 0
    while block := file.read(_BLOCK):
        *rows, left = (left + block).split(b"\0")
        count += len(rows)
        if count > MAX_FILES or len(left) > _BLOCK:
            raise PackagesTooLargeError(f"{title} has more than {MAX_FILES} files")
        yield from rows


def _blobs(rows: Iterable[bytes], title: str, tell: Callable[[str], None]) -> Iterator[_Blob]:
    for row in rows:
        found = _ROW.fullmatch(row)
        if found is None:
            raise DependencyError(f"{title}: git lists {row[:200]!r}")
        mode, kind, digest, size, name = found.groups()
        path = os.fsdecode(name)
        if kind == b"blob" and mode in (b"100644", b"100755", b"100664"):
            yield _Blob(path, digest.decode(), int(size), mode == b"100755")
        else:
            tell(f"{title}: {printable(path, 200)} is a link or a submodule, and is left out")


def _members(blobs: list[_Blob], file: IO[bytes]) -> Iterator[Member]:
    """Each behind the line that ``cat-file --batch`` writes before it."""
    end = 0
    for blob in blobs:
        start = end + len(f"{blob.digest} blob {blob.size}\n")
        end = start + blob.size + 1

        def opened(start: int = start, size: int = blob.size) -> IO[bytes]:
            file.seek(start)
            return BytesIO(file.read(size))

        yield Member(blob.path, blob.size, blob.executable, opened)


def _checked(url: str) -> str:
    found = _URL.fullmatch(url)
    if found is None or found[1] not in PROTOCOLS:
        raise RequirementError(
            f"{printable(url, 200)!r} is no address that sources are taken from: git+https://, a "
            "host and a path, without a login"
        )
    return url


def _git(
    store: Path, *arguments: str, given: bytes = b"", output: IO[bytes] | None = None
) -> bytes:
    """Run git, and return the first of what it prints, where there is no file for that.

    It prints into files, for which it has a limit: a pipe would bring all of it into our memory.
    """
    program = shutil.which("git")
    if program is None:
        raise DependencyError("sources of a repository of git are needed, and there is no git here")
    settings = [*_SETTINGS, *(f"protocol.{name}.allow=always" for name in PROTOCOLS)]
    command = [program, *(word for one in settings for word in ("-c", one)), *arguments]
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    file_bytes = MAX_BYTES if most == resource.RLIM_INFINITY else min(MAX_BYTES, most)
    limits = (str(file_bytes // 512), str(_MEMORY_KIB))  # blocks of 512 bytes, and KiB
    with tempfile.TemporaryFile(dir=store) as said, tempfile.TemporaryFile(dir=store) as printed:
        try:
            subprocess.run(
                ["/bin/sh", "-c", _LIMITED, "sh", *limits, *command],
                input=given,
                stdout=output or printed,
                stderr=said,
                cwd=store,
                env=_environment(store),
                timeout=_TIMEOUT_S,
                check=True,
            )
        except (OSError, subprocess.SubprocessError) as error:
            said.seek(max(0, said.seek(0, os.SEEK_END) - _SAID_BYTES))
            text = said.read(_SAID_BYTES).decode("utf-8", "replace") or str(error)
            raise IndexUnavailableError(
                f"git {arguments[0]} failed: {printable(text, _SAID_BYTES)}"
            ) from error
        printed.seek(0)
        return printed.read(_BLOCK)


def _environment(store: Path) -> dict[str, str]:
    """What leads to the network, and nothing of the user's own settings and logins."""
    given = index.environment()
    kept = {
        name: value
        for name, value in given.items()
        if name in ("PATH", "LANG") or name.lower().endswith("_proxy")
    }
    if certificates := given.get("SSL_CERT_FILE"):
        kept["GIT_SSL_CAINFO"] = certificates
    ours = {"GIT_CONFIG_NOSYSTEM": "1", "GIT_CONFIG_GLOBAL": os.devnull, "HOME": str(store)}
    return {**kept, **ours, **_ALONE}

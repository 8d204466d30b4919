"""Finds uv, runs it in an empty folder, and turns its refusals into our errors.

uv builds nothing, reads only our settings (``index.py``), and downloads no interpreter. Its output
is for the user, but quotes a stranger's names: this module escapes it.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import IO

from envhub_sandbox.errors import DependencyError, DependencyReason
from envhub_sandbox.extras.packages.request import Tell
from envhub_sandbox.extras.packages.resolution import index
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import locks
from envhub_sandbox.system.folders import remove_tree
from envhub_sandbox.system.platform import IS_WINDOWS
from envhub_worker.protocol.text import printable

if sys.platform == "linux":
    import resource

NO_BUILDS = ("--no-config", "--no-build")
OLDEST = (0, 11, 16)
"""Older releases install a wheel's scripts wherever the wheel says, and build editable packages in
spite of ``--no-build``. pyproject.toml requires this release too, but PATH may have another uv."""
_VERSION_S = 60.0
_SECRET = re.compile(r"(?<=://)[^/?#\s]*(?=@)|(?<=\?)[^\s?=]+=[^\s'\"`)]+")
"""Possible secrets in a URL; uv hides passwords except in queries and in malformed URLs."""
_WATCH_S = 1.0
SILENT_S = 10.0
_CLEAN_S = 60.0
CACHE_WAIT_S = 10.0
"""How long to wait for other users of uv's cache."""
LISTEN_S = 10.0
"""How long to read stderr after uv has ended: another process may keep it open for ever."""
_SHOWN = 4000
_KEPT_LINES = 400

_NO_INDEX = (
    "The package index did not answer. Check the network, or name a mirror in UV_INDEX_URL or in "
    "pip's settings; environments that exist already work offline"
)

_NO_LOGIN = (
    "An index or a proxy refused to answer without the right login. Write it into the index's URL "
    "in UV_INDEX, UV_DEFAULT_INDEX or pip's settings (https://USER:PASSWORD@HOST/simple, with "
    "other characters than letters and digits as %XX), into .netrc or a keyring; a proxy's into "
    "HTTPS_PROXY"
)

# uv's messages and their meaning for the user; the first match counts.
_MEANINGS: tuple[tuple[str, DependencyReason, str], ...] = (
    (
        r"No space left|os error 28|Disk quota|os error 122",
        "other",
        "The disk is full; 'envhub cache remove --unused-for 30' removes what was not used for "
        "30 days, 'uv cache prune' cleans uv's cache",
    ),
    (
        r"Hash mismatch|hash mismatch",
        "integrity",
        "A package has another hash than the one that is known: it was replaced on the index or "
        "during the download. It was not kept. If the index is right, resolve again: envhub "
        "inspect --download --upgrade REF",
    ),
    (r"network was disabled", "index", _NO_INDEX),
    (r"\b(401 Unauthorized|403 Forbidden|407 Proxy)", "index", _NO_LOGIN),
    (
        r"yanked",
        "resolution",
        "A release was yanked by its authors. Use another version, or name this one exactly: "
        "'name==version'",
    ),
    (r"No solution found|unsatisfiable", "resolution", ""),
    (
        r"Failed to fetch|error sending request|Request failed|Connection|dns error|timed out"
        r"|certificate|Failed to download|HTTP status",
        "index",
        _NO_INDEX,
    ),
)


def run(
    arguments: Sequence[str],
    *,
    what: str,
    given: str = "",
    timeout_s: float,
    tell: Tell = lambda line: None,
    keep: Iterable[int] = (),
    watch: Callable[[], None] = lambda: None,
    file_bytes: int | None = None,
    files: Mapping[str, str] = {},
    variables: Mapping[str, str] = {},
) -> str:
    """Runs uv to its end; returns its output.

    Args:
        keep: Descriptors that uv keeps open until it ends.
        watch: Called repeatedly; an exception from it ends uv.
        file_bytes: The largest file that uv may write.
        files: Texts for files in uv's folder, by name.
        variables: Environment variables of uv's that override ours.

    Raises ``DependencyError``: uv fails or is missing.
    """
    lines, done = list[str](), threading.Event()
    with (
        tempfile.TemporaryDirectory(prefix="envhub-uv-") as nowhere,
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as stdin,
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as printed,
    ):
        # uv reads projects and settings in its working directory
        for name, text in files.items():
            Path(nowhere, name).write_text(text, "utf-8")
        stdin.write(given)
        stdin.seek(0)
        process = subprocess.Popen(
            [command(), *arguments],
            stdin=stdin,
            stdout=printed,
            stderr=subprocess.PIPE,
            cwd=nowhere,
            env={**index.environment(), **variables},
            pass_fds=() if IS_WINDOWS else tuple(keep),
            text=True,
            errors="replace",
        )
        heard = (process.stderr, lines, tell, done)
        # uv stays in our process group: a signal that kills a server's group must reach uv
        listener = threading.Thread(target=_listen, args=heard, daemon=True)
        with process:
            try:
                listener.start()
                if file_bytes is not None:
                    _limit_files(process, file_bytes)
                _wait(process, timeout_s, watch, tell)
            except subprocess.TimeoutExpired:
                text = f"{what}: uv was not done after {timeout_s:.0f} s"
                raise DependencyError(text, reason="index") from None
            finally:
                process.kill()
                listener.join(LISTEN_S)
                done.set()
                if listener.is_alive():
                    process.stderr = None  # closing it would wait for the listener
        if sys.platform != "win32" and process.returncode == -signal.SIGXFSZ:
            raise DependencyError(
                f"{what}: a file would have become larger than {file_bytes} bytes", reason="size"
            )
        if process.returncode != 0:
            raise _error(what, "\n".join(lines))
        printed.seek(0)
        return printed.read()


def _limit_files(process: subprocess.Popen[str], largest: int) -> None:
    if process.poll() is None and sys.platform == "linux":  # elsewhere only ``watch`` limits sizes
        hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
        limit = largest if hard == resource.RLIM_INFINITY else min(largest, hard)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        # no core dump: the signal would write one
        resource.prlimit(process.pid, resource.RLIMIT_CORE, (0, 0))


def _wait(
    process: subprocess.Popen[str], timeout_s: float, watch: Callable[[], None], tell: Tell
) -> None:
    begun = time.monotonic()
    told = 0.0
    while True:
        waited = time.monotonic() - begun
        try:
            process.wait(min(_WATCH_S, max(timeout_s - waited, 0)))
            return
        except subprocess.TimeoutExpired:
            if waited >= timeout_s:
                raise
            watch()
            if waited - told >= SILENT_S:  # uv prints nothing while it waits for an index
                told = waited
                tell(f"uv is still at work after {waited:.0f} s; is the package index slow?")


def _listen(stream: IO[str], lines: list[str], tell: Tell, done: threading.Event) -> None:
    """Pass on the lines of stderr until ``done``, and keep the last ones."""
    for line in stream:
        if done.is_set():
            return
        del lines[:-_KEPT_LINES]
        lines.append(printable(_SECRET.sub("****", line.rstrip()), 500))
        tell(lines[-1].strip())


def command() -> str:
    """Returns uv's path; ``DependencyError`` if uv is missing or too old."""
    path: str | None
    try:
        from uv import find_uv_bin  # it knows pip's folder for uv, which may not be on PATH

        path = str(find_uv_bin())
    except (ImportError, FileNotFoundError):
        path = shutil.which("uv")
    if path is None:
        raise DependencyError(
            "uv, which resolves and installs packages, is neither installed in this interpreter "
            "nor on PATH. Run: pip install uv. Or use this interpreter's packages, with "
            f"{option_name('dependencies', 'host')}"
        )
    _check_release(path)
    return path


@lru_cache(maxsize=8)
def _check_release(path: str) -> None:
    try:
        said = subprocess.run(
            [path, "--version"], capture_output=True, timeout=_VERSION_S, check=True, text=True
        ).stdout
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise DependencyError(f"{path} does not say its version: {error}") from error
    version = re.match(r"uv (\d+)\.(\d+)\.(\d+)", said)
    if version is None or tuple(map(int, version.groups())) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise DependencyError(
            f"{path} is {printable(said.strip(), 80)!r}: uv before {oldest} lets a package write "
            f"outside its folder. Run: pip install 'uv>={oldest}'"
        )


def _error(what: str, said: str) -> DependencyError:
    # uv addresses the author of the requirements, but the user reads it
    plain = re.sub(r"^warning: .* is missing an upload date.*\n", "", said, flags=re.MULTILINE)
    plain = re.sub(r"\byour requirements are unsatisfiable", "nothing satisfies all of them", plain)
    plain = re.sub(r"\b[Yy]ou require\b", "it is required that there be", plain)
    text = re.sub(r"^hint: ", "  ", plain, flags=re.MULTILINE).strip()[-_SHOWN:]
    for pattern, reason, meaning in _MEANINGS:
        if re.search(pattern, said):
            host = option_name("dependencies", "host")
            offline = f", and {host} takes the packages of this interpreter as they are"
            cure = f" {meaning}{offline * (meaning == _NO_INDEX)}." if meaning else ""
            return DependencyError(f"{what}.{cure}\n{text}", reason=reason)
    return DependencyError(f"{what}; uv says:\n{text}")


@contextlib.contextmanager
def cleared_after_refusal(pins: Sequence[str]) -> Iterator[None]:
    """Remove refused packages from uv's cache; uv can download them again.

    uv unpacks a download in its cache before it installs it, and keeps the files when it is ended:
    otherwise a wheel that is too large would be found there the next time.
    """
    begun = time.time()
    try:
        yield
    except DependencyError as error:
        if error.reason == "index":
            raise  # these downloads are worth keeping
        # a second earlier: the file system's clock may be some milliseconds behind
        if _remove_unfinished(index.uv_cache(), begun - 1):
            names = sorted({pin.partition("==")[0] for pin in pins})
            with contextlib.suppress(DependencyError):
                run(
                    ["cache", "clean", "--no-config", *names],
                    what="uv's cache could not be cleaned",
                    timeout_s=_CLEAN_S,
                )
        raise


def _remove_unfinished(cache: Path, since: float) -> bool:
    """Remove uv's temporary folders of this time, if no running uv could own one.

    Each running uv holds this shared lock. If one is still running, removes nothing and returns
    False.
    """
    with contextlib.suppress(OSError), locks.held(cache / ".lock", wait_s=CACHE_WAIT_S):
        for path in cache.glob(".tmp*"):
            if path.lstat().st_mtime >= since:
                remove_tree(path)
        return True
    return False

"""uv: found, started in a folder of nobody's, and its refusals as errors of ours.

It is told to build nothing, to read no settings but ours (``index.py``), and to download no
interpreter. What it prints is the user's to read, but quotes a stranger's names: it is escaped.
"""

from __future__ import annotations

import re
import resource
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from envhub_sandbox.dependencies import index
from envhub_sandbox.errors import (
    DependencyError,
    IndexUnavailableError,
    PackageIntegrityError,
    PackagesTooLargeError,
    ResolutionError,
)
from envhub_sandbox.option_names import option_name
from envhub_worker.protocol.text import printable

NO_BUILDS = ("--no-config", "--no-build")
OLDEST = (0, 11, 16)
"""Before, a wheel's scripts went wherever the wheel said, and what is editable was built in spite
of ``--no-build``. pyproject.toml asks for the same; but there may be another on PATH."""
_VERSION_S = 60.0
_SECRET = re.compile(r"(?<=://)[^/?#\s]*(?=@)|(?<=\?)[^\s?=]+=[^\s'\"`)]+")
"""What may be one in a URL; uv hides passwords, but for those in a query or in what is no URL."""
_WATCH_S = 1.0
_SHOWN = 4000
_KEPT_LINES = 400

_NO_INDEX = (
    "The package index did not answer. Look at the network, or name a mirror that can be reached "
    "in UV_INDEX_URL or in pip's settings; what was made here before works offline"
)

# What uv says, and what that means for the user; the first that is found counts.
_MEANINGS: tuple[tuple[str, type[DependencyError], str], ...] = (
    (
        r"No space left|os error 28|Disk quota|os error 122",
        DependencyError,
        "The disk is full; 'envhub cache remove --unused-for 30' frees what nobody used for long, "
        "and 'uv cache prune' what uv keeps",
    ),
    (
        r"Hash mismatch|hash mismatch",
        PackageIntegrityError,
        "A package is not the one whose hash is known: it was replaced on the index, or on its way "
        "here. Nothing of it was kept. If the index is right, resolve again: envhub prefetch "
        "--upgrade REF",
    ),
    (r"network was disabled", IndexUnavailableError, _NO_INDEX),
    (
        r"yanked",
        ResolutionError,
        "A release was taken back by its authors. Ask for another version, or name this one "
        "exactly: 'name==version'",
    ),
    (r"No solution found|unsatisfiable", ResolutionError, ""),
    (
        r"Failed to fetch|error sending request|Request failed|Connection|dns error|timed out"
        r"|certificate|Failed to download|HTTP status",
        IndexUnavailableError,
        _NO_INDEX,
    ),
)


def run(
    arguments: Sequence[str],
    *,
    what: str,
    given: str = "",
    timeout_s: float,
    tell: Callable[[str], None] = lambda line: None,
    keep: Iterable[int] = (),
    watch: Callable[[], None] = lambda: None,
    file_bytes: int | None = None,
    files: Mapping[str, str] = {},
    variables: Mapping[str, str] = {},
) -> str:
    """Run uv to its end, and return what it printed.

    Args:
        arguments: After ``uv``.
        what: What it is asked for, for errors.
        given: Its standard input.
        timeout_s: For how long at most.
        tell: Gets each line of its progress as it comes.
        keep: Descriptors that it keeps open for as long as it lives.
        watch: Called now and then; what it raises ends it.
        file_bytes: The largest file that it may write.
        files: Texts that it finds in its folder, by name.
        variables: Of its environment, instead of ours.

    Raises:
        DependencyError: It failed, or there is none.
    """
    with tempfile.TemporaryDirectory(prefix="envhub-uv-") as nowhere:
        # uv reads projects and settings of the folder that it runs in
        for name, text in files.items():
            Path(nowhere, name).write_text(text, "utf-8")
        process = subprocess.Popen(
            [command(), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=nowhere,
            env={**index.environment(), **variables},
            pass_fds=tuple(keep),
            text=True,
            errors="replace",
        )
        with process:
            if file_bytes is not None:
                _limit_files(process, file_bytes)
            said = _Listener(process, tell)
            try:
                printed = said.exchange(given, timeout_s, watch)
            except subprocess.TimeoutExpired:
                text = f"{what}: uv was not done after {timeout_s:.0f} s"
                raise IndexUnavailableError(text) from None
            finally:
                process.kill()
    if process.returncode == -signal.SIGXFSZ:
        raise PackagesTooLargeError(
            f"{what}: a file was about to have more than {file_bytes} bytes"
        )
    if process.returncode != 0:
        raise _error(what, said.text)
    return printed


def _limit_files(process: subprocess.Popen[str], largest: int) -> None:
    if process.poll() is not None:
        return
    hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
    limit = largest if hard == resource.RLIM_INFINITY else min(largest, hard)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
    # no core of it either: the signal would leave one
    resource.prlimit(process.pid, resource.RLIMIT_CORE, (0, 0))


class _Listener:
    """Reads both outputs of a process at once; the first as a whole, the other by lines."""

    def __init__(self, process: subprocess.Popen[str], tell: Callable[[str], None]) -> None:
        self._process = process
        self._tell = tell
        self._lines: list[str] = []
        self._printed = ""

    @property
    def text(self) -> str:
        """The last lines that it wrote on stderr."""
        return "\n".join(self._lines)

    def exchange(self, given: str, timeout_s: float, watch: Callable[[], None]) -> str:
        """Write to it, read until it ends, and return what it printed."""
        threads = [threading.Thread(target=work) for work in (self._read, self._listen)]
        for thread in threads:
            thread.start()
        try:
            assert self._process.stdin is not None
            try:
                self._process.stdin.write(given)
                self._process.stdin.close()
            except BrokenPipeError:
                pass  # it says on stderr why it has gone
            self._wait(timeout_s, watch)
        except BaseException:
            self._process.kill()
            raise
        finally:
            for thread in threads:
                thread.join()
        return self._printed

    def _wait(self, timeout_s: float, watch: Callable[[], None]) -> None:
        until = time.monotonic() + timeout_s
        while True:
            try:
                self._process.wait(min(_WATCH_S, max(until - time.monotonic(), 0)))
                return
            except subprocess.TimeoutExpired:
                if time.monotonic() >= until:
                    raise
                watch()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self._printed = self._process.stdout.read()

    def _listen(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            del self._lines[:-_KEPT_LINES]
            self._lines.append(printable(_SECRET.sub("****", line.rstrip()), 500))
            self._tell(self._lines[-1].strip())


def command() -> str:
    """uv's path.

    Raises:
        DependencyError: It is not installed, or too old.
    """
    found: str | None
    try:
        from uv import find_uv_bin  # it knows where pip has put it, which need not be on PATH

        found = str(find_uv_bin())
    except (ImportError, FileNotFoundError):
        found = shutil.which("uv")
    if found is None:
        raise DependencyError(
            "uv resolves and installs packages, and is not found: neither among this interpreter's "
            "packages nor on PATH. Run: pip install uv. Or take the packages of this one as they "
            f"are, with {option_name('dependencies', 'host')}"
        )
    _check_release(found)
    return found


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
            f"outside of its folder. Run: pip install 'uv>={oldest}'"
        )


def _error(what: str, said: str) -> DependencyError:
    text = _in_the_users_words(said)[-_SHOWN:]
    for pattern, kind, meaning in _MEANINGS:
        if re.search(pattern, said):
            cure = f" {meaning}{_offline() if meaning == _NO_INDEX else ''}." if meaning else ""
            return kind(f"{what}.{cure}\n{text}")
    return DependencyError(f"{what}; uv says:\n{text}")


def _offline() -> str:
    host = option_name("dependencies", "host")
    return f", and {host} takes the packages of this interpreter as they are"


def _in_the_users_words(said: str) -> str:
    """uv speaks to whoever wrote the requirements, and that is not who reads it here."""
    plain = re.sub(r"\byour requirements are unsatisfiable", "nothing satisfies all of them", said)
    plain = re.sub(r"\b[Yy]ou require\b", "it is required that there be", plain)
    return re.sub(r"^hint: ", "  ", plain, flags=re.MULTILINE).strip()

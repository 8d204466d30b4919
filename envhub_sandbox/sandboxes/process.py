"""``sandbox="process"``: runs the worker server as a child process, with a folder of its own.

One server with a warm zygote serves all environments of this process. It is a new interpreter with
environment variables and descriptors of its own. It holds a pidfd of this process and ends when
this process ends. ``LocalServer`` is any server that is our child, also in a container.

Each server has a private folder with its sockets, whose paths have at most 107 bytes. The client
locks a file in the folder while it lives, so that others can remove the folder of a client that was
killed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import envhub_worker.protocol
from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.sandboxes.pool import ServerPool, ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import extras
from envhub_sandbox.system.locks import LifeLock, is_held
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.platform import (
    IS_LINUX,
    IS_WINDOWS,
    NAME,
    OwnerProcess,
    boot_id,
    has_ended,
    own_cpus,
    pidfd,
    readable_within,
    user_id,
)
from envhub_sandbox.system.threads import starting
from envhub_worker.protocol.runtime import OWN, Runtime, site_options

BOOTSTRAP = Path(envhub_worker.protocol.__file__).parent.parent / "bootstrap.py"
_STARTUP_S = 60.0
_STOP_S = 5.0
_KEPT_VARIABLES = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "TMPDIR", "PYTHONHASHSEED")
SERVER = "envhub-"
CONTAINER = "envhub-docker-"
_NAME = re.compile(rf"{SERVER}(docker-|scratch-|state-)?[a-z0-9_]{{8}}")
_CLIENT_FILE = "alive"
_LOCK_FILE = "lock"
_BEGUN = {f".{_CLIENT_FILE}", f".{_LOCK_FILE}"}
_SOCKET_BYTES = 107
_LONGEST = f"/{CONTAINER}12345678/sockets/server"
_EMPTY_S = 60.0
"""A folder that is empty for longer was left by a client that was killed."""


def worker_program(*arguments: str) -> list[str]:
    """The command that runs a program of ``bootstrap.py`` in this interpreter."""
    return [sys.executable, "-I", str(BOOTSTRAP), *site_options(), *arguments]


class LocalServer(WorkerServer):
    """A worker server that this process starts as a child.
    ``prefix``: the beginning of its folder's name.
    ``sockets``: the folder of its sockets, relative to its folder.
    ``stop_s``: how long its process may take to end.
    ``process``: the server's process, or the monitor of its container.
    """

    fd_path: str
    stopped = True  # until there is something to stop

    def __init__(self, prefix: str, sockets: str, stop_s: float) -> None:
        self._owner = OwnerProcess()
        self._stop_s = stop_s
        self._process: subprocess.Popen[bytes] | None = None  # None before its start
        self.process_fd = -1
        self._runtime = RuntimeFolder(prefix)  # of mode 0700: the endpoint is ours alone
        self.stopped = False
        self._sockets = [os.path.join(sockets, name) for name in ("server", "fds")]  # in the folder
        endpoint, self.fd_path = (f"{self.folder}/{name}" for name in self._sockets)
        self.endpoint = f"ipc://{endpoint}"

    @property
    def folder(self) -> Path:
        """The folder with its sockets and its log."""
        return self._runtime.path

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The child process."""
        assert self._process is not None
        return self._process

    @contextlib.contextmanager
    def starting(self, start: Callable[[int], subprocess.Popen[bytes]]) -> Iterator[int]:
        """Start the process; yields the pipe on which it says that it is ready. A failure ends it.
        ``start``: starts the process; its argument is the end of the pipe for the process.
        """
        try:
            ready, ready_end = os.pipe()
            try:
                try:
                    with starting("a worker server"):
                        self._process = start(ready_end)
                finally:
                    os.close(ready_end)
                if sys.platform == "linux":
                    self.process_fd = os.pidfd_open(self.process.pid)
                yield ready
            finally:
                os.close(ready)
        except BaseException:
            self.stop()
            raise

    @property
    def runs(self) -> bool:
        """Whether the server runs and can be reached.

        A killed server is a zombie, which can be reaped only when its threads have ended. If a
        cleaner of temporary files has removed its sockets, nobody can connect.
        """
        alive = self.process.poll() is None and not has_ended(self.process.pid)
        return alive and all((self.folder / name).is_socket() for name in self._sockets)

    def stop(self) -> None:
        """End the server and remove its folder; interruption.md, rule 7."""
        if self.stopped or not self._owner.is_here:
            return
        if self._process is not None:
            self._process.terminate()
            try:
                if self.process_fd >= 0:  # Popen.wait would look again only after 31 ms, then 63
                    readable_within(self.process_fd, self._stop_s)
                self._process.wait(0 if self.process_fd >= 0 else self._stop_s)
            except subprocess.TimeoutExpired:
                self._process.kill()  # a container ends when its monitor's pipe closes
                self._process.wait()
        self._runtime.remove()  # a killed monitor of a container has not removed it
        with contextlib.suppress(OSError):
            self.stopped = True  # before close: closing twice could close another file's number
            os.close(self.process_fd)

    def __del__(self) -> None:
        self.stop()  # interruption.md, rule 5: a Ctrl-C may come before the server is noted


class ProcessSandbox(Sandbox):
    """Runs workers on this machine, confined by the kernel."""

    name = "process"
    is_here = True

    def __init__(self) -> None:
        self._pool: ServerPool[LocalServer] = ServerPool()

    def package_target(self) -> Any:
        """The target that makes packages for the interpreters of this machine."""
        return extras.find("envhub_sandbox.extras.packages.packages", "HERE")

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[LocalServer]:
        """Use the server of this process; start it if there is none.

        A server's jails have the cores that this program had when the server started. If it has
        others now, it gets another server.
        """
        check_platform()
        return self._pool.acquire((store, *own_cpus()), partial(_start, store, runtime), idle_s)


def check_platform() -> None:
    """Raise ``SandboxUnavailableError`` if this program cannot start a server here."""
    if not IS_LINUX:
        raise SandboxUnavailableError(
            f"{option_name('sandbox', 'process')} needs Linux, and this is {NAME}, where nothing "
            f"can confine a process. Run it in a container, with {option_name('sandbox', 'docker')}"
            " (build its image once, in a checkout: docker build -t envhub-worker .), or on a "
            "Linux host where 'envhub-worker listen' runs, with "
            f"{option_name('sandbox', 'tcp://HOST:PORT')}"
        )
    if not BOOTSTRAP.is_file():
        raise SandboxUnavailableError(
            f"{BOOTSTRAP.parent} is no folder (is it in a zip archive?), and a jail's interpreter "
            "runs the files there. Install envhub-sandbox with pip, and leave it out of the archive"
        )


def _start(store: Path, runtime: Runtime) -> LocalServer:
    # The order matters. Until the server is ready this process only waits, so slow work that is
    # not needed earlier costs nothing here: the import of ZeroMQ, and removing stale folders. That
    # is why no module that `make_env` imports may import ZeroMQ or `transport.connection`;
    # `session` imports them where it uses them. The import runs in a thread, where a Ctrl-C does
    # not reach it, because an interrupted import of ZeroMQ can never be repeated. Any failure or
    # interrupt here ends the server.
    importing = threading.Thread(target=_import_quietly, name="envhub-import", daemon=True)
    server = LocalServer(SERVER, "", _STOP_S)
    with server.starting(partial(_execute, server, store, runtime)) as ready:
        with starting("a thread"):
            importing.start()
        remove_stale()
        _wait_until_ready(ready, server)
        importing.join()
        _import_transport()
    return server


def _import_quietly() -> None:
    with contextlib.suppress(Exception):  # the second import raises the error
        _import_transport()


def _import_transport() -> None:
    """Import all modules that speak with a server; these two import the others."""
    from envhub_sandbox.transport.shared_memory import attachment, lane  # noqa: F401


def _execute(
    server: LocalServer, store: Path, runtime: Runtime, ready: int
) -> subprocess.Popen[bytes]:
    arguments = [
        *worker_program("worker", "serve"),
        *("--endpoint", server.endpoint, "--runtime-dir", str(server.folder)),
        *("--readable-root", str(store)),
        *("--ahead", "--python", runtime.python, "--packages", runtime.packages),
    ]
    with (server.folder / "server.log").open("wb") as log, pidfd() as ourselves:
        kept = {name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ}
        # one thread: the server computes nothing, and idle threads of OpenBLAS spin at first
        return subprocess.Popen(
            [*arguments, "--ready-fd", str(ready), "--client-pidfd", str(ourselves)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd="/",
            env={**kept, "OPENBLAS_NUM_THREADS": "1"},
            pass_fds=(ready, ourselves),
            start_new_session=True,  # Ctrl-C is for the client, which then closes us
        )


def _wait_until_ready(ready: int, server: LocalServer) -> None:
    readable = readable_within(ready, _STARTUP_S)
    if readable and os.read(ready, 16):
        return
    log = (server.folder / "server.log").read_text("utf-8", "replace")[-4000:]
    failure = "ended" if readable else f"was not ready after {_STARTUP_S:.0f} s"
    raise WorkerStartupError(f"the worker server {failure} ({sys.executable}):\n{log}")


PROCESS = ProcessSandbox()


# --- private folders


class RuntimeFolder:
    """A new private folder, which is locked while this process lives.
    Raises ``SandboxUnavailableError``: no folder can be made.
    """

    def __init__(self, prefix: str) -> None:
        self.path = _made(prefix)
        try:
            self._lock = LifeLock(self.path / _CLIENT_FILE, f"{boot_id()} {os.getpid()}\n")
        except BaseException:
            shutil.rmtree(self.path, ignore_errors=True)
            raise

    def remove(self) -> None:
        """Remove the folder and its contents. Idempotent."""
        self._lock.release()  # first: Windows removes no file that is open
        shutil.rmtree(self.path, ignore_errors=True)


def _made(prefix: str) -> Path:
    """Make a folder in the first of the ``places`` that permits it."""
    why = ""
    for parent in places():
        # only on Linux the folder has sockets
        if not IS_LINUX or len(os.fsencode(parent) + os.fsencode(_LONGEST)) <= _SOCKET_BYTES:
            try:
                return Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
            except OSError as error:
                why = why or f" ({error.strerror}: {parent})"
    raise SandboxUnavailableError(
        f"no folder can be used for sockets: their paths can have {_SOCKET_BYTES} bytes at most, "
        f"and {', '.join(map(str, places()))} are too long or not writable{why}; set TMPDIR to a "
        "shorter path, or to a writable folder (in a container: --tmpfs /tmp)"
    )


def places() -> list[Path]:
    """The parent folders for runtime folders, best first; sockets need a short path."""
    parents = []
    with contextlib.suppress(FileNotFoundError):  # no temporary folder can be written
        parents.append(Path(tempfile.gettempdir()))
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.path.isabs(own) and user_id() != 0:  # root's jails are another user
        parents.append(Path(own))
    return list(dict.fromkeys([*parents, *([] if IS_WINDOWS else [Path("/tmp")])]))


def stale_folders(parent: Path) -> Iterator[Path]:
    """Our folders in ``parent`` whose client (or server, if it has no client) has ended."""
    for path in sorted(parent.glob(f"{SERVER}*")):
        with contextlib.suppress(OSError):
            if _NAME.fullmatch(path.name) and _belongs_to_us(path) and _is_deserted(path):
                yield path


def remove_stale() -> list[Path]:
    """Remove stale folders that this machine made since it booted; returns them.

    Folders of other machines stay: a shared file system may not share locks.
    """
    folders = [path for parent in places() for path in stale_folders(parent)]
    ours = [path for path in folders if not _is_elsewhere(path)]
    for path in ours:
        shutil.rmtree(path, ignore_errors=True)
        WORKER.info("removed %s, which a client that was killed had left", path)
    return ours


def is_in_use(path: Path) -> bool:
    """Whether the client of a runtime folder lives.
    Raises ``FileNotFoundError``: it is not a client's folder; ``OSError``: the lock is unknown.
    """
    if not (path.is_absolute() and _NAME.fullmatch(path.name)):
        raise FileNotFoundError(errno.ENOENT, "it is no runtime folder", str(path))
    return is_held(path / _CLIENT_FILE)


def _is_elsewhere(path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return boot_id() not in (path / _CLIENT_FILE).read_text()
    return False


def _belongs_to_us(path: Path) -> bool:
    status = path.lstat()
    mine = IS_WINDOWS or (status.st_uid == user_id() and status.st_mode & 0o066 == 0)
    return stat.S_ISDIR(status.st_mode) and mine


def _is_deserted(path: Path) -> bool:
    names = set(os.listdir(path))
    for name in (_CLIENT_FILE, _LOCK_FILE):
        if name in names:
            return not is_held(path / name)
    # the client was killed before its first file had its final name
    return names <= _BEGUN and time.time() - path.stat().st_mtime > _EMPTY_S

"""``sandbox="process"``: the worker server as a child process on this machine.

One server serves all environments of this process: it keeps a warm zygote. It is a fresh
interpreter with a built environment and named descriptors, and it ends when this process does,
whatever ended it: it holds a pidfd of us.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import envhub_worker.protocol
from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.log import WORKER
from envhub_sandbox.option_names import option_name
from envhub_sandbox.sandboxes import runtime_folder
from envhub_sandbox.sandboxes.lingering import Lingering
from envhub_sandbox.sandboxes.refcount import Sharing, Use, Uses
from envhub_sandbox.sandboxes.runtime_folder import RuntimeFolder
from envhub_sandbox.system import processes
from envhub_sandbox.transport.forks import Owner
from envhub_worker.protocol.runtime import OWN, Runtime

BOOTSTRAP = Path(envhub_worker.protocol.__file__).parent.parent / "bootstrap.py"
_STARTUP_S = 60.0
_STOP_S = 5.0
_KEPT_VARIABLES = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "TMPDIR")


@dataclass
class ProcessServer:
    """A worker server that we started."""

    endpoint: str
    process_fd: int
    process: subprocess.Popen[bytes]
    runtime: RuntimeFolder
    owner: Owner = field(default_factory=Owner)
    uses: Uses = field(default_factory=Uses)
    stopped: bool = False

    @property
    def folder(self) -> Path:
        """Where its sockets and its log lie."""
        return self.runtime.path

    @property
    def fd_path(self) -> str:
        """The socket that takes descriptors."""
        return str(self.folder / "fds")

    @property
    def runs(self) -> bool:
        """Whether it has not ended, and can be reached.

        One that was killed is a zombie before its threads are gone, and only then can it be waited
        for: it takes no requests any more. Nor can anyone connect to one whose sockets a cleaner
        of temporary files has removed; who is connected already goes on.
        """
        alive = self.process.poll() is None and not processes.has_ended(self.process.pid)
        return alive and self.runtime.has_sockets("server", "fds")

    def stop(self) -> None:
        """End it and everything below it, in bounded time. A fork of its owner does nothing.

        Idempotent; what interrupts it, it goes on after.
        """
        if self.stopped or not self.owner.is_here:
            return
        self.process.terminate()
        try:
            self.process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.runtime.remove()
        try:
            self.stopped = True  # once: the number may be somebody else's a moment later
            os.close(self.process_fd)
        except OSError:
            return

    def __del__(self) -> None:
        self.stop()  # a start that was interrupted before anybody noted it


class ProcessSandbox:
    """Workers on this machine, confined by the kernel."""

    name = "process"

    def __init__(self) -> None:
        self._servers: Sharing[ProcessServer] = Sharing(Lingering())

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> Use[ProcessServer]:
        """The server for this process, started if there is none."""
        if not sys.platform.startswith("linux"):
            raise SandboxUnavailableError(
                f"{option_name('sandbox', 'process')} needs Linux, and this is {sys.platform}: "
                "nothing here can confine a process. Run the worker in a container or on a Linux "
                "host."
            )
        return self._servers.acquire(store, partial(_start, store, runtime), idle_s)


def _start(store: Path, runtime: Runtime) -> ProcessServer:
    folder = RuntimeFolder(runtime_folder.SERVER)  # of mode 0700: the endpoint is ours alone
    endpoint = f"ipc://{folder.path}/server"
    ready, ready_end = os.pipe()
    process = None
    try:
        process = _execute(folder.path, store, runtime, endpoint, ready_end)
        server = ProcessServer(endpoint, os.pidfd_open(process.pid), process, folder)
    except BaseException:
        if process is not None:
            process.kill()
            process.wait()
        os.close(ready)
        folder.remove()
        raise
    finally:
        os.close(ready_end)
    try:
        for path in runtime_folder.remove_stale():  # while it starts, this costs nothing
            WORKER.info("removed %s, which a client that was killed had left", path)
        _wait_until_ready(ready, server)
    except BaseException:
        server.stop()
        raise
    finally:
        os.close(ready)
    return server


def _execute(
    folder: Path, store: Path, runtime: Runtime, endpoint: str, ready: int
) -> subprocess.Popen[bytes]:
    arguments = [
        *(sys.executable, "-I", str(BOOTSTRAP), "worker", "serve"),
        *("--endpoint", endpoint, "--runtime-dir", str(folder)),
        *("--readable-root", str(store)),
        *("--ahead", "--python", runtime.python, "--packages", runtime.packages),
    ]
    with (folder / "server.log").open("wb") as log, processes.pidfd() as ourselves:
        return subprocess.Popen(
            [*arguments, "--ready-fd", str(ready), "--client-pidfd", str(ourselves)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd="/",
            env=_environment(),
            pass_fds=(ready, ourselves),
            start_new_session=True,  # Ctrl-C is for the client, which then closes us
        )


def _environment() -> dict[str, str]:
    kept = {name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ}
    # it computes nothing, and idle threads of OpenBLAS spin at first
    return {**kept, "OPENBLAS_NUM_THREADS": "1"}


def _wait_until_ready(ready: int, server: ProcessServer) -> None:
    readable, _, _ = select.select([ready], [], [], _STARTUP_S)
    if readable and os.read(ready, 16):
        return
    log = (server.folder / "server.log").read_text("utf-8", "replace")[-4000:]
    what = "ended" if readable else f"was not ready after {_STARTUP_S:.0f} s"
    raise WorkerStartupError(f"the worker server {what} ({sys.executable}):\n{log}")


PROCESS = ProcessSandbox()

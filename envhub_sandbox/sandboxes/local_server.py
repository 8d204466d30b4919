"""A worker server that is started as a child of this process, with its sockets in our folder."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from envhub_sandbox.sandboxes.pool import WorkerServer
from envhub_sandbox.sandboxes.runtime_folder import RuntimeFolder
from envhub_sandbox.system.processes import OwnerProcess, has_ended


class LocalServer(WorkerServer):
    """A worker server that we start.

    Args:
        prefix: What the name of its folder begins with.
        sockets: The part of the folder that its sockets lie in.
        stop_s: How long its process may take to end.

    Attributes:
        process: What was started: the server itself, or what ends it when it ends.
    """

    fd_path: str
    stopped = True  # until there is something to stop

    def __init__(self, prefix: str, sockets: str, stop_s: float) -> None:
        self._owner = OwnerProcess()
        self._stop_s = stop_s
        self._process: subprocess.Popen[bytes] | None = None
        self.process_fd = -1
        self._runtime = RuntimeFolder(prefix)  # of mode 0700: the endpoint is ours alone
        self.stopped = False
        self._sockets = [os.path.join(sockets, name) for name in ("server", "fds")]
        endpoint, self.fd_path = (f"{self.folder}/{name}" for name in self._sockets)
        self.endpoint = f"ipc://{endpoint}"

    @property
    def folder(self) -> Path:
        """Where its sockets and its log lie."""
        return self._runtime.path

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The child that was started."""
        assert self._process is not None
        return self._process

    @contextlib.contextmanager
    def starting(self, start: Callable[[int], subprocess.Popen[bytes]]) -> Iterator[int]:
        """Start the process; gives the pipe that it answers on. What fails in here ends it.
        ``start``: starts it, with the end of the pipe that it writes to.
        """
        try:
            ready, ready_end = os.pipe()
            try:
                try:
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
        """Whether it has not ended, and can be reached.

        One that was killed is a zombie before its threads are gone, and only then can it be waited
        for: it takes no requests any more. Nor can anyone connect to one whose sockets a cleaner
        of temporary files has removed; who is connected already goes on.
        """
        alive = self.process.poll() is None and not has_ended(self.process.pid)
        return alive and self._runtime.has_sockets(*self._sockets)

    def stop(self) -> None:
        """End it and everything below it, in bounded time. A fork of its owner does nothing.

        Idempotent. If interrupted, the next call finishes the work: interruption.md,
        rule 7.
        """
        if self.stopped or not self._owner.is_here:
            return
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(self._stop_s)
            except subprocess.TimeoutExpired:
                self._process.kill()  # of a container's monitor: its pipe closes, which ends it
                self._process.wait()
        self._runtime.remove()  # also where a container's monitor was killed itself
        with contextlib.suppress(OSError):
            self.stopped = True  # once: the number may be somebody else's a moment later
            os.close(self.process_fd)

    def __del__(self) -> None:
        self.stop()  # interruption.md, rule 5: a start was interrupted before it was noted

"""A server that is our child: it ends with what was started for it, however its start went."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from envhub_sandbox.sandboxes.process import SERVER, LocalServer
from envhub_sandbox.system.platform import has_ended
from tests.support.processes import eventually

DEAF = "import os, signal; signal.signal(15, signal.SIG_IGN); os.close(1); os.read(0, 1)"


@pytest.fixture
def server() -> Iterator[LocalServer]:
    made = LocalServer(SERVER, "", 0.2)
    yield made
    made.stop()


def sleeping(ready: int) -> subprocess.Popen[bytes]:
    """A process that says at once that it is ready."""
    os.write(ready, b"1")
    return subprocess.Popen(["sleep", "1000"])


def listen(path: str) -> socket.socket:
    found = socket.socket(socket.AF_UNIX)
    found.bind(path)
    return found


def test_it_runs_while_it_can_be_reached(server: LocalServer) -> None:
    """Its process lives, and both sockets are there: a cleaner may have removed them."""
    with server.starting(sleeping) as ready:
        assert os.read(ready, 1) == b"1"
        assert os.read(ready, 1) == b"", "our own copy of its end is closed"
    assert not server.runs
    with listen(server.endpoint.removeprefix("ipc://")), listen(server.fd_path):
        assert server.runs
        os.unlink(server.fd_path)
        assert not server.runs
        with listen(server.fd_path):
            assert server.runs
            os.kill(server.process.pid, signal.SIGKILL)
            assert eventually(lambda: not server.runs)


def test_stop_leaves_nothing(server: LocalServer) -> None:
    """Neither the process, nor the folder, nor a descriptor; a second one closes nothing else."""
    with server.starting(sleeping):
        assert server.folder.stat().st_mode & 0o777 == 0o700
    fd = server.process_fd
    server.stop()
    assert server.process.returncode == -signal.SIGTERM
    assert not server.folder.exists()
    os.dup2(2, fd)  # the number is another's now
    try:
        server.stop()
        os.fstat(fd)
    finally:
        os.close(fd)


def test_one_that_does_not_end_is_killed(server: LocalServer) -> None:
    started = [sys.executable, "-c", DEAF]
    child = subprocess.Popen(started, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdin is not None
    with child.stdin, child.stdout, server.starting(lambda _: child):
        assert child.stdout.read() == b"", "it ignores SIGTERM from now on"
        server.stop()
        assert child.returncode == -signal.SIGKILL


def test_what_fails_in_its_start_ends_it(server: LocalServer) -> None:
    with pytest.raises(KeyboardInterrupt), server.starting(sleeping):
        raise KeyboardInterrupt
    assert has_ended(server.process.pid)
    assert (server.stopped, server.folder.exists()) == (True, False)

    def fails(ready: int) -> subprocess.Popen[bytes]:
        raise FileNotFoundError("no interpreter")

    second = LocalServer(SERVER, "", 0.2)
    with pytest.raises(FileNotFoundError), second.starting(fails):
        pass
    assert (second.stopped, second.folder.exists()) == (True, False)


def test_a_fork_of_its_owner_ends_nothing(server: LocalServer) -> None:
    with server.starting(sleeping):
        pass
    child = os.fork()
    if child == 0:
        try:
            server.stop()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert server.process.poll() is None
    assert server.folder.exists()

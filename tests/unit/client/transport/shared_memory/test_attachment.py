"""Descriptors on their way to the server: a connection that is lost in between is made again."""

from __future__ import annotations

import os
import select
import socket
import threading
from pathlib import Path

import pytest

from envhub_sandbox.transport.shared_memory.attachment import deposit
from envhub_worker.supervisor import fd_store


def serving(path: Path, losses: int) -> threading.Thread:
    """A server that ends so many connections unheard, and answers the next."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(path))
    listener.listen(8)
    listener.settimeout(60)

    def run() -> None:
        with listener:
            try:
                for _ in range(losses):
                    listener.accept()[0].close()
                connection, _ = listener.accept()
            except TimeoutError:  # whoever brings gave up before, or never came
                return
            with connection:
                _, fds, _, _ = socket.recv_fds(connection, 4096, 5)
                socket.send_fds(connection, [b"k"], [fds[0]])
                for fd in fds:
                    os.close(fd)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("losses", [0, 2])
def test_a_lost_connection_is_made_again(
    tmp_path: Path, losses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a server that waited in vain has given up is brought once more."""
    monkeypatch.chdir(tmp_path)  # a socket's path has 108 bytes
    server = serving(Path("fds"), losses)
    ours, theirs = os.pipe()
    os.close(deposit("fds", bytes(16), 1, 2, [ours]))
    os.close(ours)
    os.close(theirs)
    server.join(60)
    assert not server.is_alive()


def test_a_server_that_has_not_heard_of_the_jail_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More often than one that fails: its zygote may be held up for a while."""
    monkeypatch.chdir(tmp_path)
    ours, theirs = os.pipe()
    fds = [os.dup(ours) for _ in range(fd_store.FDS)]
    known = [-1] * 10 + [ours]
    deposits = fd_store.FdStore("fds", lambda request: known.pop(0))

    def serve() -> None:
        while known:
            select.select([deposits], [], [], 60)
            deposits.accept()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    os.close(deposit("fds", bytes(16), 1, 2, fds))
    thread.join(60)
    assert not thread.is_alive()
    taken = deposits.take(1, 2)
    assert len(taken) == len(fds)
    for fd in (*fds, *taken, ours, theirs):
        os.close(fd)
    deposits.close()


def test_a_server_that_takes_nothing_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    serving(Path("fds"), 50)
    with pytest.raises(ConnectionError):
        deposit("fds", bytes(16), 1, 2, [0])
    with pytest.raises(OSError, match="No such file"):
        deposit("nowhere", bytes(16), 1, 2, [0])

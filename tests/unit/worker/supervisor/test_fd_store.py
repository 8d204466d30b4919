"""What a server keeps of descriptors that are brought: five of a known runner's, and no others."""

import socket
from pathlib import Path

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.fd_store import FDS, FdStore
from tests.support.processes import open_descriptors

DEPOSIT = b"".join(m.pack(m.Deposit(b"mine", 1, 1)))


@pytest.mark.parametrize(
    ("said", "count", "pidfd", "reply"),
    [
        (DEPOSIT, FDS, 0, m.TAKEN),
        (DEPOSIT, FDS, -1, m.NOT_YET),
        (DEPOSIT, FDS, None, b""),
        (DEPOSIT, FDS - 1, 0, b""),
        (DEPOSIT, 0, 0, b""),
        (b"noise", FDS, 0, b""),
        (b"".join(m.pack(m.Done())), FDS, 0, b""),
        (None, 0, 0, b""),  # it says nothing, and keeps nobody waiting for long
    ],
)
def test_what_is_not_taken_is_closed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    said: bytes | None,
    count: int,
    pidfd: int | None,
    reply: bytes,
) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket has 107 bytes at most
    store = FdStore("fds", lambda _: pidfd)
    brought = tmp_path / "brought"
    with brought.open("w") as file, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.connect("fds")
        if said is not None:
            socket.send_fds(client, [said], [file.fileno()] * count)
        store.accept()
        kept = FDS if reply == m.TAKEN else 0
        assert open_descriptors(brought) == 1 + kept
        answer, given, _, _ = socket.recv_fds(client, 64, 1)
        assert (answer, len(given)) == (reply, int(reply == m.TAKEN))
        assert len(store.take(1, 1)) == kept
    store.close()

"""Messages with descriptors between our own processes."""

import contextlib
import errno
import os
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from envhub_worker.spawn.channel import MAX_MESSAGE_BYTES, Channel


@pytest.fixture
def ends() -> Iterator[tuple[Channel, Channel]]:
    ours, theirs = Channel.pair()
    other = Channel(theirs)
    yield ours, other
    ours.close()
    other.close()


def test_message_arrives_with_its_descriptors(ends: tuple[Channel, Channel]) -> None:
    ours, theirs = ends
    read, write = os.pipe()
    ours.send({"op": "x", "n": 1}, [write])
    message, (copy,) = theirs.receive() or ({}, [])
    assert message == {"op": "x", "n": 1}
    assert not os.get_inheritable(copy)
    os.write(copy, b"through")
    os.write(write, b" both")
    assert os.read(read, 20) == b"through both"
    for fd in (read, write, copy):
        os.close(fd)


def test_nothing_there_is_not_the_end(ends: tuple[Channel, Channel]) -> None:
    ours, theirs = ends
    assert ours.drain() == ([], False)
    theirs.send({"a": 1})
    theirs.close()
    assert ours.drain() == ([({"a": 1}, [])], True)


def test_last_words_arrive_although_our_own_were_never_read(ends: tuple[Channel, Channel]) -> None:
    """A peer that closes with unread messages resets the stream; what it sent still counts."""
    ours, theirs = ends
    ours.send({"unread": True})
    theirs.send({"last": "words"})
    theirs.close()
    assert ours.drain() == ([({"last": "words"}, [])], True)


def test_full_socket_keeps_the_order(ends: tuple[Channel, Channel]) -> None:
    ours, theirs = ends
    for n in range(2000):
        ours.send({"n": n, "padding": "x" * 1000})
    seen = []
    while len(seen) < 2000:
        message, _ = theirs.receive() or ({"n": None}, [])
        seen.append(message["n"])
        ours.flush()
    assert seen == list(range(2000))


def test_sending_to_nobody_is_no_error(ends: tuple[Channel, Channel]) -> None:
    ours, theirs = ends
    theirs.close()
    ours.send({"a": 1})
    assert ours.drain() == ([], True)


def _pidfds_of_ourselves() -> int:
    """Those of other processes are other threads', which come and go meanwhile."""
    count, line = 0, f"Pid:\t{os.getpid()}"
    for info in Path("/proc/self/fdinfo").iterdir():
        with contextlib.suppress(FileNotFoundError):
            count += line in info.read_text().splitlines()
    return count


def test_a_message_that_cannot_be_sent_is_an_error_and_holds_up_no_other(
    ends: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one whose descriptors the kernel refuses: its sender knows what waits for it."""
    ours, theirs = ends
    sends = socket.send_fds

    def refuse(sock: socket.socket, data: list[bytes], fds: Sequence[int], *flags: int) -> int:
        if fds:
            raise OSError(errno.ETOOMANYREFS, "Too many references")
        return sends(sock, data, fds, *flags)

    monkeypatch.setattr(socket, "send_fds", refuse)
    with pytest.raises(OSError, match="Too many references"):
        ours.send_pidfd({"n": 1}, os.getpid())
    assert _pidfds_of_ourselves() == 0
    ours.send({"n": 2})
    assert theirs.receive() == ({"n": 2}, [])


def test_oversized_message_is_refused(ends: tuple[Channel, Channel]) -> None:
    with pytest.raises(ValueError, match="over"):
        ends[0].send({"a": "x" * MAX_MESSAGE_BYTES})
    ends[0].close()
    assert ends[1].receive() is None

"""Replies are taken as they arrive; how a worker server has ended is told, with what to do."""

import os
import select
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import pytest

from envhub_sandbox.errors import (
    RemoteProtocolError,
    WorkerDiedError,
    WorkerStartupError,
    WorkerTimeoutError,
)
from envhub_sandbox.transport.connection import WorkerConnection, describe_exit
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import WireLimits
from tests.attacks.client.lying_server import Asked, Frames, LyingServer, lying
from tests.support import inside
from tests.support.processes import eventually


@contextmanager
def process(script: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    with subprocess.Popen(["sh", "-c", script]) as child:
        pidfd = os.pidfd_open(child.pid)
        try:
            yield child, pidfd
        finally:
            os.close(pidfd)


@pytest.mark.parametrize(
    ("script", "says", "code"),
    [
        ("kill -KILL $$", " by SIGKILL, by another process or by the kernel", -9),
        ("kill -TERM $$", " by SIGTERM. The next", -15),
        ("exit 3", ", with exit code 3. The next", 3),
        ("exit 137", " with its container, by SIGKILL, by another process or by the kernel", 137),
        ("exit 143", " with its container, by SIGTERM. The next", 143),
    ],
)
def test_its_end_is_told(script: str, says: str, code: int) -> None:
    """By itself, or as an engine tells of its container's program."""
    with process(script) as (child, pidfd):
        assert select.select([pidfd], [], [], 120)[0]
        told = describe_exit(pidfd)
        assert told.startswith(says)
        assert told.endswith("starts another")
        assert ("DockerSandbox(memory=" in told) == (code == 137)
        assert child.wait() == code


def test_what_another_has_reaped_ended_somehow() -> None:
    with process("exit 3") as (child, pidfd):
        child.wait()
        assert describe_exit(pidfd).startswith(". The next")
    living = os.pidfd_open(os.getpid())
    try:
        assert describe_exit(living).startswith(". The next")
    finally:
        os.close(living)


@contextmanager
def connected() -> Iterator[tuple[LyingServer, WorkerConnection]]:
    with lying() as server:
        connection = WorkerConnection(server.endpoint, server.process_fd)
        try:
            yield server, connection
        finally:
            connection.close()


def test_a_reply_is_there_once_it_has_arrived() -> None:
    """To ask for it takes nothing away, and it is received as it would have been."""
    held: list[Frames] = []

    def hold(asked: Asked) -> list[Frames]:
        held.append(asked.answer(asked.honest))
        return []

    with connected() as (server, connection):
        server.lies[m.CheckJail] = hold
        first = connection.send(m.CheckJail(1, ""))
        assert eventually(lambda: bool(held))
        assert not connection.arrived(first)
        server.lies[m.GetStatus] = lambda asked: [*held, asked.answer(asked.honest)]
        second = connection.send(m.GetStatus())
        assert eventually(lambda: connection.arrived(first))
        assert connection.arrived(first)
        for _ in range(2):
            assert connection.peek(first) == (m.Done(), [])
        assert connection.peek(second) == (None, [])
        assert connection.receive(first, Deadline(0))[0] == m.Done()
        assert connection.peek(first) == (None, [])
        assert eventually(lambda: connection.arrived(second))
        assert connection.receive(second, Deadline(0))[0] == m.Status(())
        third = connection.send(m.GetStatus())
        assert eventually(lambda: connection.arrived(third))
        connection.forget(third)
        assert not connection.arrived(third)


def test_a_frame_over_the_limit_does_not_arrive() -> None:
    """It is refused by its length, before libzmq takes memory for it."""
    with lying() as server:
        server.lies[m.CheckJail] = lambda asked: [asked.answer(m.Status(("x" * 20_000,)))]
        limits = WireLimits(frame_bytes=10_000)
        connection = WorkerConnection(server.endpoint, server.process_fd, limits)
        try:
            with pytest.raises(WorkerTimeoutError):
                connection.request(m.CheckJail(1, ""), deadline=Deadline(1))
        finally:
            connection.close()


def test_other_replies_are_dropped_while_one_is_looked_for() -> None:
    """As many as there are, and counted; the one that follows them is found. At each look one of
    them at most: a flood has no end, and a deadline holds in it."""
    dropped = [0]

    def flood(asked: Asked) -> list[Frames]:
        stale = [asked.answer(m.Done(), asked.request_id + 1000 + i) for i in range(50)]
        return [*stale, asked.answer(asked.honest)]

    with connected() as (server, connection):
        server.lies[m.CheckJail] = flood
        sent = connection.send(m.CheckJail(1, ""))

        def look() -> bool:
            there = connection.arrived(sent)
            dropped.append(connection.stale_replies)
            return there

        assert eventually(look)
        assert dropped[-1] == 50
        assert max(later - before for before, later in pairwise(dropped)) == 1
        assert connection.receive(sent, Deadline(0))[0] == m.Done()


def test_what_is_no_reply_is_raised_where_it_is_received() -> None:
    with connected() as (server, connection):
        server.lies[m.CheckJail] = lambda asked: [[b"noise"]]
        sent = connection.send(m.CheckJail(1, ""))
        assert eventually(lambda: connection.arrived(sent))
        assert connection.peek(sent) == (None, [])
        with pytest.raises(RemoteProtocolError):
            connection.receive(sent, Deadline(0))


def test_a_reply_is_looked_for_again_after_a_compressed_one() -> None:
    """Where a wait was interrupted; the last reply that was read is another one."""
    compressed = m.pack_header(m.CompressionHeader("lz4", ()), 0)
    with connected() as (server, connection):
        server.lies[m.CheckJail] = lambda asked: [compressed]
        with pytest.raises(RemoteProtocolError):  # none was agreed on
            connection.request(m.CheckJail(1, ""), deadline=Deadline(60))
        sent = connection.send(m.GetStatus())
        assert connection.reply_again(sent, Deadline(60)) == m.Status(())


def test_an_interrupt_in_a_look_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reply may be lost then; after any other look nothing is."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with connected() as (_, connection):
        sent = connection.send(m.GetStatus())
        assert eventually(lambda: connection.arrived(sent))
        assert not connection.arrived(sent + 1)
        assert not connection.torn
        again = connection.send(m.GetStatus())
        monkeypatch.setattr("envhub_sandbox.transport.connection.Deadline", interrupted)
        with pytest.raises(KeyboardInterrupt):
            eventually(lambda: connection.arrived(again))
        assert connection.torn


def test_the_end_of_a_server_has_arrived_as_well() -> None:
    with process("sleep 1000") as (child, pidfd), lying() as server:
        server.lies[m.CheckJail] = lambda asked: []
        connection = WorkerConnection(server.endpoint, pidfd)
        sent = connection.send(m.CheckJail(1, ""))
        assert not connection.arrived(sent)
        child.kill()
        assert eventually(lambda: connection.arrived(sent))
        with pytest.raises(WorkerDiedError, match="by SIGKILL"):
            connection.receive(sent, Deadline(0))
        connection.close()


def test_the_log_names_each_message(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", "envhub_sandbox.messages")
    with lying() as server:
        client = WorkerConnection(server.endpoint, server.process_fd)
        client.request(m.Hello(m.VERSION, b"a secret"), deadline=Deadline(60))
        client.request(m.CheckJail(1, "step"), deadline=Deadline(60))
        with pytest.raises(WorkerTimeoutError):
            client.receive(99, Deadline(0))
        client.close()
    assert [line.strip() for line in caplog.messages] == [
        *("> 1 Hello", "< 1 Welcome", "> 2 CheckJail step", "< 2 Done")
    ]


def test_a_process_without_room_for_threads_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ would abort it. The first thread still starts, and ends."""
    before, start = threading.active_count(), threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if threading.active_count() > before:
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(*inside.CONTEXTS, {})
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(WorkerStartupError, match="ulimit -u"):
        WorkerConnection("ipc:///nowhere", -1)
    assert threading.active_count() == before

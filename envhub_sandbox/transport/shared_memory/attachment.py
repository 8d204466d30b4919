"""Gives the slabs and doorbells of shards to their runners, and watches these runners."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from time import monotonic, sleep

from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.transport.connection import SESSION
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.shared_memory.client_slabs import LaneShard
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory.descriptors import Watch

_ANSWER_S = 20.0
_LEAST_S = 0.1
"""The most time that a server gets to take descriptors, and the least, however late it is."""
_TRIES = 3
_AGAIN_S = 0.005


class Attachment:
    """The runners of one environment that share memory with this process.

    Args:
        path: The socket at which the server takes descriptors.
        jail: The number of the runners' jail.
        process_fd: A descriptor that becomes readable when the worker server ends.

    Attributes:
        watch: Wakes up when a runner rings its doorbell, or when a runner or the server ends.
    """

    def __init__(self, path: str, jail: int, process_fd: int) -> None:
        self._path = path
        self._jail = jail
        self._pidfds: dict[int, int] = {}  # by shard; we own them
        self.watch = Watch()
        self.watch.death(process_fd)

    def hand_over(self, index: int, runner: int, shard: LaneShard, deadline: Deadline) -> None:
        """Give a shard's runner its ends of the slabs and doorbells.
        Raises ``WorkerDiedError``: the runner or the server has ended.
        """
        # In this order. The bell is watched before a runner can ring it. The server gives the pidfd
        # in exchange for the descriptors, so the death that we watch is that of their new holder;
        # it becomes ours by ``_pidfds`` before anything else is called (interruption.md, rule 4).
        # Our copies of the runner's ends are closed last: if we kept them, a bell whose runner has
        # died would look open, and every deposit would hold five descriptors of this process.
        self.watch.bell(shard.bell)
        try:
            left_s = deadline.left_s()
            wait_s = _ANSWER_S if left_s is None else min(_ANSWER_S, max(_LEAST_S, left_s))
            pidfd = deposit(self._path, SESSION, self._jail, runner, shard.fds, wait_s)
        except OSError as error:
            text = "the worker process died before its first request"
            raise WorkerDiedError(text, request="make_env") from error
        self._pidfds[index] = pidfd
        self.watch.death(pidfd)
        shard.handed_over()

    def forget(self, index: int, shard: LaneShard) -> None:
        """Stop watching a shard's runner, which has died, and its doorbell."""
        pidfd = self._pidfds.pop(index)
        self.watch.forget(pidfd)
        os.close(pidfd)
        self.watch.forget(shard.bell)

    def answers(self, index: int, shard: LaneShard, deadline: Deadline) -> bool:
        """Wait for a shard; returns whether it answers before its runner dies."""
        watch = Watch()
        watch.bell(shard.bell)
        watch.death(self._pidfds[index])
        try:
            return shard.answered_before_death(watch, deadline)
        finally:
            watch.close()

    def close(self) -> None:
        """Stop watching all runners."""
        self.watch.close()
        for index, pidfd in list(self._pidfds.items()):
            del self._pidfds[index]  # interruption.md, rule 4
            os.close(pidfd)


def deposit(
    path: str, session: bytes, jail: int, runner: int, fds: Sequence[int], wait_s: float = _ANSWER_S
) -> int:
    """Hand descriptors to the server for a runner; returns a pidfd of the jail, or of the runner.

    The server waits for one second for a connection's message, and does nothing else meanwhile. If
    the garbage collector closes another environment between our connect and our send, it waits for
    that same server, which drops the connection. So a failed deposit is repeated: descriptors for
    the same runner replace those of the first try. A server that has not yet heard of the jail
    from its zygote says so, and is asked again, too.
    Raises ``OSError``: the server did not take them.
    """
    [frame] = m.pack(m.Deposit(session, jail, runner))
    until, tries = monotonic() + wait_s, 1
    while True:
        try:
            pidfd = _deposit(path, frame, fds, wait_s)
        except (ConnectionError, TimeoutError):
            tries += 1
            if tries > _TRIES:
                raise
            continue
        if pidfd is not None:
            return pidfd
        if monotonic() > until:
            raise TimeoutError("the worker server did not hear of the jail in time")
        sleep(_AGAIN_S)


def _deposit(path: str, frame: bytes | memoryview, fds: Sequence[int], wait_s: float) -> int | None:
    """Try once to hand over descriptors; None if the server does not know the jail yet."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(wait_s)
        connection.connect(path)
        socket.send_fds(connection, [frame], list(fds))
        data, received, _, _ = socket.recv_fds(connection, 16, 1)
    if data == m.NOT_YET and not received:
        return None
    if data != m.TAKEN or len(received) != 1:
        raise ConnectionError("the worker server did not take the descriptors")
    return received[0]

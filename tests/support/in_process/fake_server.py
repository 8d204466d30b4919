"""A connection to a server that is not there: a test answers what was sent, when it likes."""

from collections.abc import Sequence
from itertools import count
from typing import Any

from envhub_sandbox.errors import EnvHubError, WorkerTimeoutError
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m

Frames = Sequence[Any]


class FakeServer:
    """What a ``JailHandle`` uses of a ``WorkerConnection``."""

    def __init__(self) -> None:
        self.sent: list[tuple[m.Relay, Frames]] = []
        self.ids: list[int] = []
        self.refuses: EnvHubError | None = None
        self.torn = False
        self._count = count(1)
        self._replies: dict[int, tuple[m.Message, list[Any]]] = {}

    def request(self, message: m.Message, *, deadline: Deadline) -> tuple[m.Message, list[Any]]:
        return m.Done(), []

    def send(self, message: m.Message, payload: Frames = ()) -> int:
        """Note it. Every runner takes its slabs."""
        if self.refuses is not None:
            raise self.refuses
        request_id = next(self._count)
        if message.deposited:
            taken = [m.pack(m.Value(True)) for _ in message.parts]
            self.reply(m.RelayDone((1,) * len(taken)), *taken, to=request_id)
            return request_id
        self.sent.append((message, payload))
        self.ids.append(request_id)
        return request_id

    def answer(self, *parts: Frames, at: int = -1) -> None:
        """What the runners say to a relay: the last one, or one by its place."""
        self.reply(m.RelayDone(tuple(map(len, parts))), *parts, to=self.ids[at])

    def reply(self, reply: m.Message, *parts: Frames, to: int) -> None:
        """What the server says to a request."""
        self._replies[to] = reply, [frame for part in parts for frame in part]

    @property
    def untaken(self) -> int:
        """Replies that have come and are kept."""
        return len(self._replies)

    def arrived(self, request_id: int) -> bool:
        return request_id in self._replies

    def peek(self, request_id: int) -> tuple[m.Message | None, list[Any]]:
        return self._replies.get(request_id, (None, []))

    def keep(self, request_id: int) -> None:
        """Every reply is kept here."""

    def forget(self, request_id: int) -> None:
        self._replies.pop(request_id, None)

    def receive(self, request_id: int, deadline: Deadline) -> tuple[m.Message, list[Any]]:
        if request_id not in self._replies:
            raise WorkerTimeoutError("the worker did not answer in time")
        return self._replies.pop(request_id)

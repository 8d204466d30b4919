"""An environment without a jail: real session and requests, over a lane that answers at once."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.settings.policy import Policy, Timeouts
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import WatchedAttributes
from envhub_sandbox.transport.lane import Request
from envhub_sandbox.transport.remote_warnings import RemoteWarnings
from envhub_sandbox.transport.results import StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from tests.attacks.client.lying_server import NUM_ENVS, OBSERVATION, env_manifest


class FakeLane:
    """A lane to one shard: see ``transport.lane.Lane``.

    Attributes:
        sent: The messages that came, in order.
        answer: What a request other than a reset is answered.
        fails: Raised by the next wait.
        owed: What was sent and not answered.
    """

    name = "fake"

    def __init__(self) -> None:
        ignore = lambda *_: None  # noqa: E731
        self.jail = SimpleNamespace(watched=WatchedAttributes(), send=ignore, receive=ignore)
        self.runners, self.number, self.elapsed_ns = [1], 7, 1
        self.sent: list[m.Message] = []
        self.answer: m.Message = m.Value((None,) * NUM_ENVS)
        self.fails: BaseException | None = None
        self.owed: m.Message | None = None
        self.closed = False

    def request(self, operation: str, messages: Sequence[m.Message]) -> Request:
        """Ready to be sent."""
        frames = [m.pack(message) for message in messages]
        return Request(operation, messages, frames, [(0, NUM_ENVS)], plain=True)

    def send(self, request: Request) -> None:
        """Owe an answer."""
        self._owe(request.messages[0])

    def send_step(self, actions: Any) -> None:
        """Owe a step."""
        self._owe(m.Step(self.number, actions))

    def _owe(self, message: m.Message) -> None:
        assert self.owed is None, "the answer to an earlier request would be taken for this one's"
        self.sent.append(message)
        self.owed = message

    def wait(self, deadline: Deadline) -> None:
        """It is there."""
        if self.fails is not None:
            error, self.fails = self.fails, None
            raise error
        self.owed = None

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        """Of one step."""
        no = np.zeros(NUM_ENVS, np.bool_)
        return _observation(), np.zeros(NUM_ENVS), no, no, {}

    def replies(self, deadline: Deadline) -> list[m.Message]:
        """The answer that is owed."""
        asked = self.owed
        self.wait(deadline)
        if isinstance(asked, m.Reset):
            return [m.ResetDone(_observation(), {})]
        return [self.answer]

    def catch_up(self, deadline: Deadline) -> None:
        """Drop what is owed."""
        if isinstance(self.fails, WorkerTimeoutError):
            raise self.fails
        self.owed = None

    def traffic(self) -> tuple[int, int, int]:
        """None."""
        return 0, 0, 0

    def close(self) -> None:
        """Nothing is used any more."""
        self.closed = True


class FakeRepository(Repository):
    """A repository without files, of which no crash is kept."""

    def __init__(self) -> None:
        known = {"label": "a/b", "path": None, "root": None, "assets": (), "hub_copies": ()}
        self.snapshot = cast("Any", SimpleNamespace(**known))
        self.policy, self.timeouts = Policy(crash_history=8), Timeouts()
        self.warnings, self.recipe, self.copy = RemoteWarnings(), None, True

    def keep_crash(self, *_: object, **__: object) -> None:
        """There is none."""


def _observation() -> Any:
    return np.zeros((NUM_ENVS, *OBSERVATION.shape), OBSERVATION.dtype)


def session_over(lane: FakeLane) -> EnvSession:
    """A session that is READY, with its environment behind this lane."""
    repository = FakeRepository()
    launcher = SimpleNamespace(repository=repository, stay=lambda: lambda: None)
    jails = SimpleNamespace(launcher=launcher, shared=False)
    trials = SimpleNamespace(note=lambda *_: None)
    session = EnvSession(cast("Any", jails), env_manifest(), [(0, NUM_ENVS)], cast("Any", trials))
    session.lease.lane = cast("Any", lane)
    session.lifecycle.state = State.READY
    return session

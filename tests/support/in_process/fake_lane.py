"""An environment without a jail: real session and requests, over a lane that answers at once."""

import os
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_sandbox.extras.several_workers.fleet_session import FleetSession
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.recorder import Recorder, recorder_for
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.settings.policy import Policy, Timeouts
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle, Request
from envhub_sandbox.transport.remote_warnings import RemoteWarnings
from envhub_sandbox.transport.results import StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from tests.attacks.client.lying_server import NUM_ENVS, OBSERVATION, env_manifest


class FakeLane:
    """A lane to one shard: see ``transport.lane.Lane``.

    Args:
        count: How many sub-environments it has.

    Attributes:
        infos: Of the next steps.
        sent: The messages that came, in order.
        answer: What a request other than a reset is answered.
        fails: Raised by the next wait.
        owed: What was sent and not answered.
        silent: Whether it has not answered yet.
        listened: Whether it was asked what to poll.
        on_look, on_listen: Called before it is asked whether it has answered, and what to poll.
    """

    name = "fake"
    takes_more = False

    def __init__(self, count: int = NUM_ENVS) -> None:
        done = m.RelayDone((1,)), m.pack(m.Done())
        client = SimpleNamespace(torn=False, send=lambda *_: 1, receive=lambda *_: done)
        self.jail = JailHandle(cast("Any", client), 1, [1], [], DEFAULT_LIMITS)
        self.runners, self.number, self.elapsed_ns = [1], 7, 1
        self._count = count
        self.infos: dict[Any, Any] = {}
        self.sent: list[m.Message] = []
        self.answer: m.Message = m.Value((None,) * NUM_ENVS)
        self.fails: BaseException | None = None
        self.owed: m.Message | None = None
        self.closed = self.silent = self.listened = False
        self.on_look: Callable[[], object] = lambda: None
        self.on_listen: Callable[[], object] = lambda: None
        self._bell: list[int] = []

    def answered(self) -> bool:
        self.on_look()
        return not self.silent

    def sources(self) -> list[int]:
        self._bell = self._bell or list(os.pipe())
        self.listened = True
        self.on_listen()
        return [self._bell[0]]

    def ring(self) -> None:
        self.sources()
        os.write(self._bell[1], b"!")

    def send(self, request: Request) -> None:
        self._owe(m.unpack([bytes(frame) for frame in request.sent[0]]))

    def expect_more(self) -> None:
        """It takes no more."""

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        self._owe(m.Step(self.number, np.array(actions)))

    def _owe(self, message: m.Message) -> None:
        assert self.owed is None, "the answer to an earlier request would be taken for this one's"
        self.sent.append(message)
        self.owed = message

    def wait(self, deadline: Deadline) -> None:
        if self.fails is not None:
            error, self.fails = self.fails, None
            raise error
        self.owed = None

    def result(self, infos: dict[Any, Any] | None = None) -> StepResult:
        no = np.zeros(self._count, np.bool_)
        return _observation(self._count), np.zeros(self._count), no, no, self.infos

    def replies(self, deadline: Deadline) -> list[m.Message]:
        asked = self.owed
        self.wait(deadline)
        if isinstance(asked, m.Reset):
            return [m.ResetDone(_observation(self._count), {})]
        return [self.answer]

    def catch_up(self, deadline: Deadline) -> None:
        if isinstance(self.fails, WorkerTimeoutError):
            raise self.fails
        self.owed = None

    def traffic(self) -> tuple[int, int, int]:
        return 0, 0, 0

    def close(self) -> None:
        self.closed = True
        while self._bell:
            os.close(self._bell.pop())


class FakeRepository(Repository):
    """A repository without files, of which no crash is kept."""

    def __init__(self) -> None:
        known = {"label": "a/b", "path": None, "root": None, "assets": (), "hub_copies": ()}
        known |= {"is_local": False}
        self.snapshot = cast("Any", SimpleNamespace(**known))
        self.policy, self.timeouts = Policy(crash_history=8), Timeouts()
        self.warnings, self.recipe, self.copy = RemoteWarnings(), None, True
        self.min_ready, self.for_lerobot = None, False
        self.label, self.wire_limits = "a/b", DEFAULT_LIMITS
        self._of_its_day = lambda error: ""

    def keep_crash(self, *_: object, **__: object) -> None:
        """There is none."""


def _observation(count: int) -> Any:
    return np.zeros((count, *OBSERVATION.shape), OBSERVATION.dtype)


def fleet_over(lanes: Sequence[FakeLane]) -> FleetSession:
    """A session over two workers, with a sub-environment each."""
    repository = FakeRepository()
    recorder = recorder_for(repository.policy.crash_history)
    parts = [
        session_over(lane, (row, row + 1), repository, recorder) for row, lane in enumerate(lanes)
    ]
    return FleetSession(parts, recorder)


def session_over(
    lane: FakeLane,
    rows: tuple[int, int] = (0, NUM_ENVS),
    repository: FakeRepository | None = None,
    whole: Recorder | None = None,
) -> EnvSession:
    """A session that is READY, with its environment behind this lane."""
    repository = repository or FakeRepository()
    hold = SimpleNamespace(enter=lambda: lambda: None)
    here = {"server_hold": hold, "where": lambda _: "here"}
    launcher = SimpleNamespace(repository=repository, **here)
    jails = SimpleNamespace(launcher=launcher, shared=False)
    trials = SimpleNamespace(note=lambda *_: None)
    given = cast("Any", jails), env_manifest(), [rows], cast("Any", trials)
    session = EnvSession(*given, whole)
    session.lease.lane = cast("Any", lane)
    session.lifecycle.state = State.READY
    return session

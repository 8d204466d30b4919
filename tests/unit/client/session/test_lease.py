"""An environment's hold on a jail: whatever interrupts it, the jail is given back, once."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox.errors import ServerBusyError, WorkerDiedError
from envhub_sandbox.session import lease as lease_module
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.prewarm import SuitePrewarm
from envhub_sandbox.transport.deadline import StartupDeadline
from envhub_worker.protocol.lifecycle import Event, Lifecycle, State
from tests.support.in_process.fake_lane import FakeLane, session_over


class _Jails:
    """Where jails come from, and what was done with them, in order."""

    shared = False

    def __init__(self, launcher: Any) -> None:
        self.done: list[str] = []
        self.fails: dict[str, list[BaseException]] = {}
        self.launcher = launcher
        launcher.note_denied = lambda *_: None
        launcher.hold = lambda: lambda: self.done.append("server released")
        self.launcher.retry_s = 0.0
        self.built = 0

    def do(self, what: str) -> None:
        self.done.append(what)
        if self.fails.get(what):
            raise self.fails[what].pop()

    def take(self, deadline: object) -> Any:
        self.do("take")
        return SimpleNamespace(jail=SimpleNamespace(number=1, report=[]), server=None)

    def end(self, loaded: object) -> None:
        self.do("end")

    def give_back(self, loaded: object, *, wait: bool = True) -> None:
        self.do("give back")


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> tuple[Lease, _Jails]:
    lane = FakeLane()
    session = session_over(lane)
    hold = SimpleNamespace(enter=lambda: lambda: None, settle=lambda: False)
    jails = _Jails(SimpleNamespace(repository=session.repository, server_hold=hold))
    building = SimpleNamespace(build=lambda *_: jails.do("build") or lane)
    monkeypatch.setattr(lease_module, "Builder", lambda *_: building)
    session.lifecycle.state = State.IDLE
    lease = Lease(jails, session.requests.results, session.lifecycle, session.counters, None)
    return lease, jails


def acquire(lease: Lease) -> None:
    lease.acquire(StartupDeadline(60))


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (("steps", "waits"), ("steps", "waits")),
        (("steps", 5, None), ("steps",)),
        ("text", ()),
        (("\x1b[2J",) * 99, ("\\x1b[2J",) * 64),
        (("x" * 99,), ("x" * 40 + "...",)),
    ],
)
def test_only_words_are_taken_of_a_status(
    taken: tuple[Lease, _Jails], said: object, words: tuple[str, ...]
) -> None:
    lease, jails = taken
    jails.launcher.status = lambda *_: {"states": said}
    assert lease.states() == ()
    acquire(lease)
    assert lease.states() == words


def test_a_jail_is_taken_built_in_and_given_back_once(taken: tuple[Lease, _Jails]) -> None:
    lease, jails = taken
    acquire(lease)
    assert lease.lane is not None
    for _ in range(2):
        lease.let_go()
    assert jails.done == ["take", "build", "give back"]
    assert (lease.loaded, lease.lane) == (None, None)
    jails.done.clear()
    acquire(lease)
    lease.abandon()  # as a fork does: the jail is its parent's
    assert (jails.done, lease.lane) == (["take", "build"], None)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), WorkerDiedError("it died")])
def test_what_is_not_built_is_given_back(taken: tuple[Lease, _Jails], error: BaseException) -> None:
    lease, jails = taken
    jails.fails["build"] = [error]
    with pytest.raises(type(error)):
        acquire(lease)
    assert jails.done == ["take", "build", "give back"]
    assert lease.loaded is None
    acquire(lease)
    assert lease.loaded is not None


def test_an_interrupted_return_is_done_again(taken: tuple[Lease, _Jails]) -> None:
    lease, jails = taken
    acquire(lease)
    jails.fails["give back"] = [KeyboardInterrupt()]
    with pytest.raises(KeyboardInterrupt):
        lease.let_go()
    assert lease.loaded is not None
    lease.let_go()
    assert jails.done[2:] == ["give back", "give back"]
    assert lease.loaded is None


def test_a_server_is_held_until_the_next_jail_is_there(taken: tuple[Lease, _Jails]) -> None:
    lease, jails = taken
    acquire(lease)
    jails.done.clear()
    lease.leave()
    acquire(lease)
    assert jails.done == ["end", "give back", "take", "build", "server released"]


def test_a_full_server_is_asked_again_once_there_is_room(taken: tuple[Lease, _Jails]) -> None:
    lease, jails = taken
    full = ServerBusyError("full", quota="jails", used=1, limit=1, retry_s=0.1)
    jails.fails["take"] = [full]
    with pytest.raises(ServerBusyError):
        acquire(lease)
    jails.fails["take"] = [full]
    lease.make_room = lambda: True
    acquire(lease)
    assert lease.loaded is not None


def test_a_jail_that_comes_after_close_is_refused(taken: tuple[Lease, _Jails]) -> None:
    lease, jails = taken
    lease.lifecycle.on(Event.CLOSE)
    with pytest.raises(WorkerDiedError, match="closed during make_env"):
        acquire(lease)
    lease.let_go()
    assert jails.done == ["take", "build", "give back"]


# --- What is started ahead is a favour: a request for something else does not fail for it


class _Task:
    """One environment of a suite, as far as this concerns it."""

    lifecycle = Lifecycle()
    closed = False

    def __init__(self) -> None:
        self.warm, self.cancelled = threading.Event(), threading.Event()
        self.used: Callable[[], None] = self.warm.set

    def on_first_use(self, used: Callable[[], None], make_room: Callable[[], bool]) -> None:
        self.used, self.make_room = used, make_room

    def start(self) -> None:
        self.warm.set()

    def cancel(self) -> bool:
        self.cancelled.set()
        return True


def suite_of(count: int, ahead: int | None = 1) -> list[_Task]:
    tasks = [_Task() for _ in range(count)]
    SuitePrewarm([[[task] for task in tasks]], ahead)
    return tasks


def test_a_system_without_threads_starts_nothing_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, third = suite_of(3)

    def no_room(thread: threading.Thread) -> Any:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_room)
        first.used()
    assert not second.warm.is_set()
    second.used()
    assert third.warm.wait(60)


def test_room_is_made_of_what_is_unused_only() -> None:
    """And there is none where nothing was started ahead; what was passed over is cancelled."""
    first, second, third, fourth = suite_of(4)
    assert not first.make_room()
    first.used()
    assert second.warm.wait(60)
    assert first.make_room()
    assert (first.cancelled.is_set(), second.cancelled.is_set()) == (False, True)
    assert not third.warm.is_set()
    first, second, third, fourth = suite_of(4)
    first.used()
    assert second.warm.wait(60)
    third.used()
    assert second.cancelled.wait(60), "so that there are never more unused jails than permitted"
    assert fourth.warm.wait(60)

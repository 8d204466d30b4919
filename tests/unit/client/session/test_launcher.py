"""How a jail ends, once, whatever interrupts it; and what is taken of its server's words."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.errors import EnvHubError, ServerBusyError, WorkerDiedError, WorkerStartupError
from envhub_sandbox.sandboxes import sandbox as module
from envhub_sandbox.sandboxes.sandbox import Sandbox, retry_while_busy
from envhub_sandbox.session.builder import JailSource, SharedJail
from envhub_sandbox.session.launcher import Launcher, LoadedJail
from envhub_sandbox.transport import connection
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.server import DRAINING
from tests.support.in_process.fake_lane import FakeLane, session_over

_SERVER: Any = SimpleNamespace(endpoint="", process_fd=0, far=None)


class _Client:
    """Every connection to the server, as one."""

    def __init__(self) -> None:
        self.torn = False
        self.asked: list[m.Message] = []
        self.status: Any = ()
        self.refuses: BaseException | None = None

    def hello(self, deadline: object) -> None:
        if self.refuses is not None:
            raise self.refuses

    def request(self, message: m.Message, deadline: object) -> tuple[m.Message, list[Any]]:
        self.asked.append(message)
        return m.Status(self.status) if isinstance(message, m.GetStatus) else m.Done(), []

    def close(self) -> None:
        """Nothing is left."""


class _Place(Sandbox):
    """A place whose server is there already."""

    name = "fake"

    def __init__(self) -> None:
        self.released = 0
        self.fails = False

    def acquire(self, store: Any, runtime: Any = None, idle_s: float | None = 0.0) -> Any:
        if self.fails:
            raise WorkerStartupError("it did not come up")
        return SimpleNamespace(server=_SERVER, live=False, release=self.release)

    def release(self) -> None:
        self.released += 1


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> _Client:
    made = _Client()
    monkeypatch.setattr(connection, "WorkerConnection", lambda *_: made)
    return made


@pytest.fixture
def place() -> _Place:
    return _Place()


@pytest.fixture
def launcher(client: _Client, place: _Place) -> Launcher:
    repository = session_over(FakeLane()).repository
    repository.policy = type(repository.policy)(record_denials=True)
    repository.runtime = SimpleNamespace(python="", packages="")
    repository.places = []
    return Launcher(repository, place, Path())


def opened(launcher: Launcher, client: _Client, place: _Place) -> Any:
    waits: list[object] = []
    jail = SimpleNamespace(
        number=7,
        client=client,
        waits=waits,
        ask_to_close=lambda: waits.append,
        before_end=lambda: None,
        drop=lambda: None,
    )
    use = place.acquire(None)
    return LoadedJail(jail, None, {}, set(), use, launcher.close)


def test_a_jail_is_closed_once(launcher: Launcher, client: _Client, place: _Place) -> None:
    loaded = opened(launcher, client, place)
    for _ in range(2):
        launcher.close(loaded)
    assert loaded.closed
    assert (len(loaded.jail.waits), place.released) == (1, 1)


def test_an_interrupted_close_goes_on(launcher: Launcher, client: _Client, place: _Place) -> None:
    loaded = opened(launcher, client, place)

    def interrupted() -> Any:
        raise KeyboardInterrupt

    loaded.jail.ask_to_close = interrupted
    with pytest.raises(KeyboardInterrupt):
        launcher.close(loaded)
    assert (loaded.closed, place.released) == (False, 0)
    launcher.close(loaded)
    assert client.asked == [m.CloseJail(7)]
    assert (loaded.closed, place.released) == (True, 1)


@pytest.mark.parametrize(
    ("status", "found"),
    [
        (({"jail": 7, "states": ("steps", "waits")},), {"jail": 7, "states": ("steps", "waits")}),
        (({"jail": 8, "states": ("another's",)},), {}),
        (({"jail": 7}, 3, None), {"jail": 7}),
    ],
)
def test_the_status_of_its_own_jail_is_found(
    launcher: Launcher, client: _Client, place: _Place, status: Any, found: dict[str, Any]
) -> None:
    client.status = status
    assert launcher.status(_SERVER, 7) == found
    client.refuses = WorkerDiedError("a silent one, which is no error: it is for a text")
    assert launcher.status(_SERVER, 7) == {}
    place.fails = True
    with pytest.raises(WorkerStartupError):
        launcher.hold()
    assert place.released == 0, "where nothing was started nothing is given back"


@pytest.mark.parametrize(("reason", "asked"), [("exit", 1), ("server", 0), ("connection", 0)])
def test_denials_are_asked_for_where_the_server_can_know(
    launcher: Launcher, client: _Client, reason: Any, asked: int
) -> None:
    client.status = ({"jail": 7, "denied": ("ptrace",)},)
    error = WorkerDiedError("it died", reason=reason)
    for _ in range(2):
        launcher.note_denied(error, _SERVER, 7)
    launcher.note_denied(KeyboardInterrupt(), None, 7)
    assert len(client.asked) == asked
    assert error.denied == (("ptrace",) if asked else None)


@pytest.mark.parametrize(
    ("denied", "signal", "text"),
    [
        (("socket AF_INET", "ptrace"), "SIGSEGV", "was denied: socket AF_INET, ptrace$"),
        (tuple(f"read /{n}" for n in range(11)), None, "read /7 and 3 more$"),
        ((), "SIGSEGV", "^it died$"),
        (None, "SIGSEGV", "record_denials"),
        (None, "SIGSYS", "ends 32-bit code so, and no policy permits it; [^{]*$"),
        (None, None, "^it died$"),
    ],
)
def test_a_death_after_a_denial_names_it(
    launcher: Launcher, client: _Client, denied: Any, signal: str | None, text: str
) -> None:
    """Many a program dies of what it may not; where nothing was recorded, it says how to."""
    client.status = ({"jail": 7} if denied is None else {"jail": 7, "denied": denied},)
    kind = type(launcher.repository.policy)
    launcher.repository.policy = kind(record_denials=denied is not None)
    error = WorkerDiedError("it died", reason="signal" if signal else "exit", signal=signal)
    for _ in range(2):
        launcher.note_denied(error, _SERVER, 7)
    assert re.search(text, str(error))
    assert str(error).count("\n") <= 1


# --- Waiting for a server that has no room: as long as that is worth it, and no longer


_FULL = ServerBusyError("full", quota="jails", used=1, limit=1, retry_s=0.1)
_ENDING = ServerBusyError("it ends", quota=DRAINING, used=0, limit=0, retry_s=0.1)
_GONE = WorkerDiedError("no answer", reason="connection")


@pytest.fixture(autouse=True)
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    time = [0.0]
    monkeypatch.setattr(module, "monotonic", lambda: time[0])
    monkeypatch.setattr(module, "sleep", lambda for_s: time.__setitem__(0, time[0] + for_s))
    return time


def asked(*answers: EnvHubError, retry_s: float = 60.0, **deadline: Any) -> int:
    """How often it was asked until there was room."""
    left = list(answers)
    count = 0

    def ask() -> int:
        nonlocal count
        count += 1
        if left:
            raise left.pop(0)
        return count

    return retry_while_busy(ask, retry_s, StartupDeadline(None, **deadline), "org/repo")


@pytest.mark.parametrize("answers", [(), (_FULL,), (_FULL, _FULL), (_ENDING, _GONE, _GONE)])
def test_it_is_asked_until_there_is_room(answers: tuple[EnvHubError, ...]) -> None:
    assert asked(*answers) == len(answers) + 1


def test_the_line_ends_with_its_time(now: list[float]) -> None:
    """The refusal is the answer then; what is started in advance gives way at once."""
    with pytest.raises(ServerBusyError):
        asked(*[_FULL] * 1000, retry_s=5.0)
    assert 5.0 <= now[0] < 6.0
    for given in ({"retry_s": 0.0}, {"unasked": True}):
        with pytest.raises(ServerBusyError):
            asked(_FULL, **given)


@pytest.mark.parametrize("error", [_GONE, WorkerDiedError("killed", reason="signal")])
def test_a_death_is_no_reason_to_wait(error: EnvHubError) -> None:
    with pytest.raises(WorkerDiedError):
        asked(error)


# --- One jail for all environments of a repository: opened by the first, ended with the last


class _Loaded(SimpleNamespace):
    """A connection to the jail number 7; by identity."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__


def loaded() -> Any:
    return _Loaded(jail=MagicMock(number=7))


@pytest.fixture
def opener() -> Any:
    return MagicMock(open=MagicMock(side_effect=lambda *_: loaded()), connect=lambda *_: loaded())


def test_it_is_opened_once_and_ends_with_its_last_user(opener: Any) -> None:
    source = SharedJail(opener, lambda: None)
    source.provide(loaded())
    user = source.take(Deadline(None))
    assert not opener.open.called
    source.close()
    assert not opener.close.called
    source.give_back(user)
    source.close()
    assert opener.close.call_count == 1
    users = [source.take(Deadline(None)) for _ in range(3)]
    for user in users:
        assert (opener.open.call_count, opener.close.call_count) == (1, 1)
        source.give_back(user)
    assert opener.close.call_count == 2
    source.provide(loaded())
    source.close()
    assert (opener.open.call_count, opener.close.call_count) == (1, 3)


@pytest.mark.parametrize(("lives", "ended"), [(True, 1), (None, 1), (False, 0)])
def test_who_is_given_up_is_given_up_for_all(opener: Any, lives: bool | None, ended: int) -> None:
    """They share its process; a jail of one's own is nobody else's. What is dead stays until the
    last has left it, for the server to say why.
    """
    source = SharedJail(opener, lambda: None)
    users = [source.take(Deadline(None)) for _ in range(2)]
    opener.lives.return_value = lives
    source.end(users[0])
    assert (opener.interrupt.call_count, opener.close.call_count) == (ended, ended)
    for user in users:
        assert opener.close.call_count == ended
        source.give_back(user)
    assert opener.close.call_count == ended + 1
    own = JailSource(opener, lambda: None)
    assert own.take(Deadline(None)) is not own.take(Deadline(None))

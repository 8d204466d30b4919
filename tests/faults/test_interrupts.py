"""Ctrl-C or ``close`` at the worst moment: all is given back, and the error says what happened."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import errors, make_env
from envhub_sandbox.session import failures
from envhub_worker.protocol.lifecycle import Event, Lifecycle, State
from tests.support import inside
from tests.support.processes import descendants, eventually
from tests.support.samples import sample

pytestmark = pytest.mark.usefixtures("neighbour")
lanes = pytest.mark.parametrize("lane", ["auto", "frames"])


def made(lane: str = "auto", **options: Any) -> Any:
    fails = options.pop("fails", {"moment": "step", "fault": "hang"})
    policy = {"lane": lane, **options.pop("policy", {})}
    suites = make_env(sample("faulty"), n_envs=2, policy=policy, env_kwargs=fails, **options)
    suites.env.reset()
    return suites


@contextmanager
def begun(lane: str = "auto", **options: Any) -> Iterator[Any]:
    with made(lane, **options) as suites:
        yield suites.env


def interrupted(*arguments: Any, **options: Any) -> Any:
    """In place of whatever takes so long that somebody loses patience."""
    raise KeyboardInterrupt


def released(env: Any) -> list[bool]:
    """Have the environment hold its server; what is returned says when it has let it go."""
    found: list[bool] = []
    give_back = inside.launcher(env).hold()

    def release() -> None:
        give_back()
        found.append(True)

    inside.hold_server(env, release)
    return found


@lanes
def test_a_second_ctrl_c_in_recovery_leaves_a_usable_environment(
    lane: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The jail that was given up is given back, and the next reset has another."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 0.05)
    with begun(lane, timeouts={"step_s": 0.05}) as env:
        with pytest.raises(TimeoutError):
            env.step([0, 1])
        first = inside.loaded(env)
        with monkeypatch.context() as patch:
            patch.setattr(*inside.ending(env), interrupted)
            with pytest.raises(KeyboardInterrupt):
                env.reset()
        assert first.closed
        assert inside.state(env) is State.LATE
        env.reset()
        assert inside.loaded(env) is not first
        assert env.render() is not None


@pytest.mark.parametrize("why", ["it has died", "there is no room"])
def test_ctrl_c_while_a_prewarmed_task_ends(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make_env(sample("counter"), n_envs=2).close()  # known from here on: it starts later
    with make_env(sample("counter"), n_envs=2) as suites:
        env = suites.env
        lease, ahead = inside.session(env).lease, inside.session(env).prewarm
        ahead.start()
        give_back = lease.give_back
        with monkeypatch.context() as patch:
            patch.setattr(lease, "give_back", lambda: interrupted(give_back()))
            if why == "it has died":
                lease.end()
            with pytest.raises(KeyboardInterrupt):
                env.reset() if why == "it has died" else ahead.cancel()
        with pytest.raises(errors.WorkerDiedError, match="call reset"):
            env.step([0, 0])
        env.reset()
        env.step([0, 0])


@pytest.mark.parametrize("moment", ["amid the frames", "when all is sent"])
def test_ctrl_c_in_sending_leaves_a_late_reply(
    moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if moment == "amid the frames":  # to half a message, and to what follows it, nothing is said
        monkeypatch.setattr(*inside.WAITS_FOR_A_SERVER[0], 1.0)
    with begun("frames") as env:
        jail = inside.jail(env)
        with monkeypatch.context() as patch:
            if moment == "amid the frames":
                half = partial(_half, jail.client)
                patch.setattr(*inside.sending(jail.client), half)
            else:
                send = jail.send_relay  # a message's, or a step's that the server takes
                patch.setattr(jail, "send_relay", lambda *both: interrupted(send(*both)))
            with pytest.raises(KeyboardInterrupt):
                env.step([0, 0])
        with pytest.raises(errors.WorkerTimeoutError, match=r"step was interrupted.*call reset"):
            env.step([0, 0])
        env.reset()
        env.step([0, 0])


def _half(client: Any, frames: Any, copy: bool) -> None:
    inside.send_half(client, frames)
    raise KeyboardInterrupt


class Inside:
    """A place in the client that another thread has come to, and stays in until it may go on."""

    def __init__(self, then: Callable[..., Any]) -> None:
        self._there, self._go_on, self._then = threading.Event(), threading.Event(), then

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        self._there.set()
        assert self._go_on.wait(60)
        return self._then(*arguments, **options)

    def wait(self) -> None:
        assert self._there.wait(60)

    def leave(self) -> None:
        self._go_on.set()


def threaded(operation: Callable[[], object]) -> tuple[threading.Thread, list[BaseException]]:
    raised: list[BaseException] = []

    def run() -> None:
        try:
            operation()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread, raised


def close_during_reset(env: Any, inside: Inside) -> None:
    """Close while another thread resets and has come to a place; that raises so."""
    thread, raised = threaded(env.reset)
    inside.wait()
    env.close()
    inside.leave()
    thread.join(60)
    assert [type(one) for one in raised] == [ClosedEnvironmentError]


@pytest.mark.parametrize("restart", ["on_reset", "transparent"])
def test_close_ends_a_wait_for_a_restart(restart: str, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = Inside(lambda *_: 3600.0)
    waiting.leave()
    policy = {"restart": restart, "crash_history": 0}
    with begun(policy=policy, fails={"moment": "step", "fault": "kill"}) as env:
        if restart == "on_reset":
            with pytest.raises(errors.WorkerDiedError):
                env.step([0, 1])
        monkeypatch.setattr(failures, "backoff_s", waiting)
        loaded = inside.loaded(env)
        thread, raised = threaded(env.reset if restart == "on_reset" else lambda: env.step([0, 1]))
        waiting.wait()
        env.close()
        thread.join(60)
        assert [type(one) for one in raised] == [ClosedEnvironmentError]
        assert loaded.closed
        assert env.sandbox.stats()["restarts"] == 0


def test_who_outlasts_a_close_gives_everything_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """``close`` does not wait for ever for a thread that holds the environment."""
    monkeypatch.setattr(*inside.CLOSE_PATIENCE, 0.0)
    policy = {"restart": "on_reset", "crash_history": 0}
    with begun(policy=policy, fails={"moment": "step", "fault": "kill"}) as env:
        with pytest.raises(errors.WorkerDiedError):
            env.step([0, 1])
        found: list[list[bool]] = []

        def hold() -> Callable[[], None]:
            monkeypatch.undo()
            found.append(released(env))
            return inside.release_of_server(env)

        forgetting = Inside(hold)
        monkeypatch.setattr(*inside.holding(env), forgetting)
        close_during_reset(env, forgetting)
        assert found == [[True]]
        assert inside.loaded(env) is None


class Held:
    """A lock that another thread never gives back; it notes how long one waits for it."""

    def __init__(self) -> None:
        self.waited: list[float] = []

    def acquire(self, blocking: bool = True, timeout: float = 0.0) -> bool:
        self.waited.append(timeout)
        return False


@pytest.mark.parametrize(("close_s", "longest"), [(0.5, 0.5), (2.0, 2.0), (3600.0, 10.0)])
def test_close_waits_no_longer_than_it_may(
    close_s: float, longest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a thread that does not notice that its jail has gone: and that has gone."""
    with made(timeouts={"close_s": close_s}) as suites:
        held, before = Held(), descendants()
        with monkeypatch.context() as patch:
            patch.setattr(*inside.use_lock(suites.env), held)
            suites.env.close()
        assert sum(held.waited) == longest
        assert eventually(lambda: descendants() < before)
        inside.clean_up(suites.env)


class Closing(Lifecycle):
    """Closes the environment at a move, in the same thread, as a signal handler does."""

    def __init__(self, env: Any, event: Event, *, before: bool) -> None:
        self.state = inside.state(env)
        self._env, self._event, self._before = env, event, before

    def on(self, event: Event) -> State:
        """Move, and close right before or right after it."""
        if event is self._event and self._before:
            self._env.close()
        state = super().on(event)
        if event is self._event:
            self._env.close()
        return state


def recover(env: Any) -> None:
    inside.session(env).requests.submit_step(np.zeros(2, np.int64))
    env.reset()


OPERATIONS: dict[str, tuple[Event, Callable[[Any], object]]] = {
    "step": (Event.SUBMIT, lambda env: env.step([0, 0])),
    "reset": (Event.SUBMIT, lambda env: env.reset()),
    "render": (Event.SUBMIT, lambda env: env.render()),
    "interrupted": (Event.INTERRUPT, recover),
    "late": (Event.REPLY, recover),
}


@pytest.mark.parametrize("before", [True, False], ids=["before", "after"])
@pytest.mark.parametrize(
    ("operation", "lane"),
    [*((one, "auto") for one in OPERATIONS), ("step", "frames"), ("late", "frames")],
)
def test_closed_in_the_midst_says_closed(operation: str, lane: str, before: bool) -> None:
    """A signal handler that closes while a request is on its way out, or looked after."""
    event, ask = OPERATIONS[operation]
    with begun(lane) as env:
        loaded = inside.loaded(env)
        inside.live_by(env, Closing(env, event, before=before))
        with pytest.raises(ClosedEnvironmentError):
            ask(env)
        assert loaded.closed
        assert (inside.loaded(env), inside.lane(env)) == (None, None)

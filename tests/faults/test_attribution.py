"""No result is ever attributed to another request, and the lifecycle's table is what happens.
A state machine drives a real worker through timeouts, late replies, deaths, interrupts and
closes. Every request carries a token of its own and every answer repeats it; but for the rows of
what has died and comes back, under ``restart="transparent"``, which say so."""

import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from envhub_sandbox import errors, make_env
from envhub_worker.protocol.lifecycle import State
from tests.support import inside
from tests.support.samples import sample

_SLOW_S = 0.12
_SOON_S = 0.03
_AGES_S = 60.0
_tokens = itertools.count(1)
_OWED = (State.LATE, State.PENDING)
"""A reply may still come: late, or nobody has begun to wait for it."""
delays = st.sampled_from([0.0, 0.0, _SLOW_S])
waits = st.sampled_from([_AGES_S, _AGES_S, _SOON_S])
while_open = precondition(lambda self: self.expected is not State.CLOSED)


class Attribution(RuleBasedStateMachine):
    """One environment, and what must be true of it."""

    lane = "auto"
    shards = 1
    restart = "on_reset"
    after_death = State.DEAD

    @initialize()
    def begin(self) -> None:
        """Nothing runs yet, or a remembered manifest would not be one."""
        policy = {"restart": self.restart, "restart_backoff_s": 0, "restart_budget": 10_000}
        policy |= {"crash_history": 0, "lane": self.lane}
        options: Any = {"num_workers": self.shards, "policy": policy}
        self.suites = make_env(sample("echo"), n_envs=2, use_async_envs=True, **options)
        self.env = self.suites.env
        self.expected = self.state

    @property
    def state(self) -> State:
        return inside.state(self.env)

    def after(self, ask: Callable[[], Any], check: Callable[[Any], bool]) -> None:
        """Ask; what comes back is checked, and what is raised says where we are now."""
        before = self.expected
        try:
            answer = ask()
        except errors.WorkerTimeoutError as error:
            refused = "cannot" in str(error)
            assert not refused or before in _OWED
            self.expected = before if refused else State.LATE
        except errors.WorkerDiedError:
            self.expected = self.after_death
        except KeyboardInterrupt:
            # it may come between the sending and the waiting, of which nobody is told
            self.expected = State.PENDING if self.state is State.PENDING else State.LATE
        else:
            assert before not in (*_OWED, State.DEAD, State.CLOSED)
            assert check(answer), answer
            self.expected = State.READY

    def is_reset(self, got: Any, token: float) -> bool:
        return bool(got[0].tolist() == [[token, 0.0]] * 2)

    def is_step(self, got: Any, token: float) -> bool:
        observations, rewards, _, _, infos = got
        same = observations.tolist() == [[token, 1.0]] * 2 and rewards.tolist() == [token] * 2
        return bool(same and np.array_equal(infos["token"], [token, token]))

    @while_open
    @rule(delay=delays, wait=waits)
    def reset(self, delay: float, wait: float) -> None:
        """A reset brings it back from everywhere, and answers with its own token."""
        token = float(next(_tokens))
        if self.expected in (*_OWED, State.DEAD):
            self.expected = State.IDLE

        def ask() -> Any:
            self.env.reset_async(options={"token": token, "delay": delay})
            return self.env.reset_wait(timeout=wait)

        self.after(ask, lambda got: self.is_reset(got, token))

    @while_open
    @rule(delay=delays, wait=waits)
    def step(self, delay: float, wait: float) -> None:
        token = float(next(_tokens))

        def ask() -> Any:
            self.env.step_async([[token, delay]] * 2)
            return self.env.step_wait(timeout=wait)

        self.after(ask, lambda got: self.is_step(got, token))

    @while_open
    @rule(delay=delays, wait=waits)
    def call(self, delay: float, wait: float) -> None:
        token = float(next(_tokens))

        def ask() -> Any:
            self.env.call_async("echo", token, delay)
            return self.env.call_wait(timeout=wait)

        self.after(ask, lambda got: got == (token, token))

    @while_open
    @rule(by_step=st.booleans())
    def die(self, by_step: bool) -> None:
        if by_step:
            self.after(lambda: self.env.step([[0.0, 0.0], [0.0, -1.0]]), lambda got: False)
        else:
            self.after(lambda: self.env.call("echo", 0.0, -1.0), lambda got: False)

    @while_open
    @rule(grace=st.sampled_from([0.01, 2.0]))
    def patience(self, grace: float) -> None:
        """How long a reset waits for a late reply before it starts afresh."""
        setattr(*inside.LATE_REPLY_GRACE, grace)

    @while_open
    @rule(moment=st.sampled_from([_SOON_S]))
    def interrupt(self, moment: float) -> None:
        """Ctrl-C while a step is sent or waited for, or while the worker starts."""
        token, before, came = float(next(_tokens)), self.state, list[bool]()

        def ask() -> Any:
            try:
                signal.setitimer(signal.ITIMER_REAL, moment)
                try:
                    return self.env.step([[token, _SLOW_S]] * 2)
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:
                came.append(True)
                raise

        self.after(ask, lambda got: self.is_step(got, token))
        if came and before is State.DEAD:
            self.expected = before  # it was refused, and we were held up on the way back
        if before in (State.IDLE, State.READY) and self.state in (State.IDLE, State.READY):
            self.expected = self.state  # it came before anything was sent, or after the answer
            if came and self.state is State.READY:  # whether it was done, nobody can say
                self.reset(0.0, _AGES_S)

    @while_open
    @rule(running=st.booleans())
    def close(self, running: bool) -> None:
        """Close from another thread, under a running step or not."""
        closing = threading.Timer(_SOON_S if running else 0.0, self.env.close)
        closing.start()
        try:
            token = float(next(_tokens))
            while running:
                assert self.is_step(self.env.step([[token, _SLOW_S]] * 2), token)
        except (ClosedEnvironmentError, errors.WorkerError):
            pass
        closing.join()
        self.expected = State.CLOSED

    @precondition(lambda self: self.expected is State.CLOSED)
    @rule()
    def use_when_closed(self) -> None:
        for ask in (self.env.reset, self.env.render, lambda: self.env.step([[0.0, 0.0]] * 2)):
            with pytest.raises(ClosedEnvironmentError):
                ask()

    @invariant()
    def state_is_the_expected_one(self) -> None:
        if hasattr(self, "env"):
            assert self.state is self.expected or (
                # nothing was built, or a death was noticed before anything could be asked
                {self.state, self.expected} <= {State.IDLE, State.READY}
            )

    def teardown(self) -> None:
        """Whatever has happened, it can be closed."""
        setattr(*inside.LATE_REPLY_GRACE, 2.0)
        started = time.monotonic()
        self.suites.close()
        assert time.monotonic() - started < _AGES_S
        assert self.state is State.CLOSED


class Transparent(Attribution):
    """The same, where the dead come back by themselves."""

    restart = "transparent"
    after_death = State.READY

    def __init__(self) -> None:
        super().__init__()
        self.lost, self.over = set[int](), set[int]()

    def is_reset(self, got: Any, token: float) -> bool:
        """All rows are its own; those that came back are marked, in a jail that was not left."""
        marked, lost = _restarted(got[1]), self.lost
        self.lost, self.over = set(), set()
        return super().is_reset(got, token) and marked <= lost

    def is_step(self, got: Any, token: float) -> bool:
        """The lost rows, and no other, are fresh and marked; the next step resets just those."""
        lost, over = self.lost, self.over - self.lost
        self.lost, self.over = set(), lost
        own = [row for row in range(2) if row not in lost | over]
        observations, rewards, _, truncations, infos = got
        expected = [[token, 1.0] if row in own else [0.0, 0.0] for row in range(2)]
        tokens = infos["token"][own].tolist() if own else []
        return (
            _restarted(infos) == set(np.flatnonzero(truncations).tolist()) == lost
            and observations.tolist() == expected
            and rewards.tolist() == [token if row in own else 0.0 for row in range(2)]
            and tokens == [token] * len(own)
        )

    @while_open
    @rule(by_step=st.booleans())
    def die(self, by_step: bool) -> None:
        """The last row's process ends in a step, or all of them in a call."""
        usable = self.expected in (State.IDLE, State.READY)
        if not by_step:
            self.lost = {0, 1} if usable else self.lost
            self.after(lambda: self.env.call("echo", 0.0, -1.0), lambda got: False)
            return
        if usable and not self.lost and 1 not in self.over:
            self.lost = {0, 1} if self.shards == 1 else {1}
        self.after(lambda: self.env.step([[0, 0.0], [0, -1.0]]), lambda got: self.is_step(got, 0.0))


def _restarted(infos: dict[str, Any]) -> set[int]:
    mask = infos.get("worker_restarted", np.zeros(2))
    assert np.array_equal(mask, infos.get("_worker_restarted", np.zeros(2)))
    return set(np.flatnonzero(mask).tolist())


@pytest.fixture
def _interrupts() -> Iterator[None]:
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    yield
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("neighbour", "_interrupts")
@pytest.mark.parametrize(
    ("machine", "lane", "shards"),
    [
        (Attribution, "auto", 2),
        (Attribution, "frames", 1),
        (Transparent, "auto", 1),
        (Transparent, "frames", 2),
    ],
)
def test_no_result_is_attributed_to_another_request(
    machine: type[Attribution], lane: str, shards: int
) -> None:
    """Whatever is interleaved, an answer is the answer to its own request.
    ``ENVHUB_FAULTS=full`` tries a hundred times as much."""
    machine = type("Machine", (machine,), {"lane": lane, "shards": shards})
    examples = 800 if os.environ.get("ENVHUB_FAULTS") == "full" else 8
    few = settings(max_examples=examples, stateful_step_count=15, deadline=None, print_blob=True)
    run_state_machine_as_test(machine, settings=few)

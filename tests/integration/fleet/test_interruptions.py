"""Ctrl-C, threads and signal handlers, in an environment over several workers.
What docs/internals/interruption.md demands of one holds for all together;
``tests/integration/lifecycle/test_interruptions.py`` tries starts and closes."""

import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox.errors import EnvHubError, WorkerTimeoutError
from envhub_worker.protocol.lifecycle import State
from tests.support import inside
from tests.support.in_process.interrupts import at_call
from tests.support.processes import eventually, halted
from tests.support.started import started

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
lanes = pytest.mark.parametrize("lane", ["auto", "frames"])
WORKERS = 3
STILL = np.zeros(2 * WORKERS, np.int64)
DEADLINE_S = 60.0
_STEPS = 11
"""Calls between two moments that are tried."""


def _options(lane: str) -> dict[str, Any]:
    return {"n_envs": 2 * WORKERS, "sandbox": ["process"] * WORKERS, "policy": {"lane": lane}}


@lanes
def test_no_answer_is_taken_for_another(rows: Path, lane: str) -> None:
    """After a Ctrl-C anywhere in a step, every row goes on from where reset() has put it."""
    with started(rows, **_options(lane)) as env:
        expected = env.reset(seed=3)[0]
        moment, came = 0, True
        while came:
            came = at_call(moment, lambda: env.step(STILL))
            with suppress(WorkerTimeoutError):  # where the interrupt has left a request pending
                env.step(STILL)
            assert np.array_equal(env.reset(seed=3)[0], expected), moment
            for count in (1, 2):
                observations, _, _, _, infos = env.step(STILL)
                assert observations[:, 1].tolist() == [count] * len(STILL), moment
                assert infos["row"].tolist() == list(range(len(STILL))), moment
            moment += _STEPS
        assert moment > 5 * _STEPS
        assert env.sandbox.stats()["restarts"] == 0


def test_a_ctrl_c_while_one_computes(rows: Path) -> None:
    """The others have answered; the next step is refused, and reset() catches up."""
    with started(rows, **_options("frames")) as env:
        expected = env.reset(seed=3)[0]
        last = inside.parts(env)[-1]

        def interrupt() -> None:
            assert eventually(lambda: last.lifecycle.state is State.PENDING)
            os.kill(os.getpid(), signal.SIGINT)

        interrupting = threading.Thread(target=interrupt)
        with halted(inside.part_pids(last)):
            interrupting.start()
            with pytest.raises(KeyboardInterrupt):
                env.step(STILL)
        interrupting.join()
        with pytest.raises(WorkerTimeoutError, match="the last step was interrupted"):
            env.step(STILL)
        assert np.array_equal(env.reset(seed=3)[0], expected)
        assert env.step(STILL)[0][:, 1].tolist() == [1] * len(STILL)


def _step_on(env: Any) -> None:
    """Until something ends that, however late it comes."""
    while True:
        env.step(np.full(len(STILL), 98))


def test_close_comes_into_a_step(rows: Path) -> None:
    """From another thread, and from a signal handler of the same one: in bounded time."""
    for how in ("thread", "signal"):
        with started(rows, **_options("frames")) as env:
            begun = time.monotonic()
            if how == "thread":
                closer = threading.Timer(0.3, env.close)
            else:
                before = signal.signal(signal.SIGUSR1, lambda *_: env.close())
                closer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGUSR1))
            closer.start()
            try:
                with pytest.raises((ClosedEnvironmentError, EnvHubError)):
                    _step_on(env)
            finally:
                closer.join(DEADLINE_S)
                if how == "signal":
                    signal.signal(signal.SIGUSR1, before)
            assert time.monotonic() - begun < DEADLINE_S
            assert {part.lifecycle.state.name for part in inside.parts(env)} == {"CLOSED"}
            assert all(part.lease.loaded is None for part in inside.parts(env))
            with pytest.raises(ClosedEnvironmentError):
                env.step(STILL)


def test_a_second_thread_waits(rows: Path) -> None:
    """Two threads that step take turns, and are warned of it."""
    with started(rows, **_options("frames")) as env:
        counts: list[Any] = []

        def play() -> None:
            for _ in range(30):
                counts.append(env.step(STILL)[0][:, 1].tolist())

        def play_together() -> None:
            threads = [threading.Thread(target=play) for _ in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(DEADLINE_S)

        with pytest.warns(RuntimeWarning, match="two threads step one environment"):
            play_together()
        assert sorted(counts) == [[number] * len(STILL) for number in range(1, 121)]


def test_a_worker_that_hangs_delays_a_close_once(rows: Path) -> None:
    options = _options("auto") | {"timeouts": {"step_s": 0.2, "close_s": 2.0}}
    with started(rows, **options) as env:
        with pytest.raises(WorkerTimeoutError):
            env.step(np.full(len(STILL), 98))
        pids = [pid for part in inside.parts(env) for pid in inside.part_pids(part)]
        env.close()
        assert all(eventually(lambda p=pid: not os.path.exists(f"/proc/{p}")) for pid in pids)

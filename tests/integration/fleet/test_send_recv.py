"""``send`` and ``recv`` over servers: the wire's delay is hidden, and a lost server is its own."""

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox.errors import WorkerDiedError, WorkerTimeoutError
from tests.remote.listening import Listening
from tests.remote.relay import relay
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.processes import halted
from tests.support.started import started

AHEAD, STEPS = 16, 40


def _alone(rows: Path, count: int, steps: int) -> list[Any]:
    """What ``step`` gives."""
    with started(rows, count, seed=5) as env:
        return [env.step(np.zeros(count, np.int64)) for _ in range(steps)]


@pytest.mark.parametrize("workers", [1, 3])
def test_many_steps_are_under_way_now(rows: Path, servers: list[Listening], workers: int) -> None:
    """Each comes back in its turn, and is what it would be without the others; where all of them go
    by one connection, too."""
    nothing = np.zeros(6, np.int64)
    expected = _alone(rows, 6, STEPS)
    with relay(servers[0].port, 0.01) as wire:
        places = [servers[0].sandbox(endpoint=wire.endpoint), *(s.sandbox() for s in servers[1:])]
        place = places[:workers] if workers > 1 else places[0]
        with started(rows, 6, seed=5, sandbox=place, num_workers=workers, min_ready=6) as env:
            for _ in range(AHEAD):
                env.send(nothing)
            for step, wanted in enumerate(expected):
                *results, env_ids = env.recv()
                assert env_ids.tolist() == list(range(6))
                assert_same(wanted, tuple(results), f"step {step}")
                if step + AHEAD < STEPS:
                    env.send(nothing)
            assert env.sandbox.stats()["stale_replies"] == 0
            assert_same(*(one.step(nothing)[1:4] for one in (env, env)), "step")


def test_they_are_really_on_the_way_at_once(rows: Path, servers: list[Listening]) -> None:
    """The server has got all of them before the first answer is taken; from the second time on, for
    a first step goes through slabs, with room for one."""
    with started(rows, 1, sandbox=servers[0].sandbox(), min_ready=1) as env:
        for _ in range(3):
            env.send(np.array([0]))
        assert [env.recv().observations[0, 1] for _ in range(3)] == [1, 2, 3]
        sent = env.sandbox.stats()["sent_bytes"]
        env.send(np.array([10]))
        one = env.sandbox.stats()["sent_bytes"] - sent
        for _ in range(AHEAD - 1):
            env.send(np.array([0]))
        assert env.sandbox.stats()["sent_bytes"] - sent == AHEAD * one
        assert [env.recv().observations[0, 1] for _ in range(AHEAD)] == list(range(4, AHEAD + 4))


def test_a_server_is_lost_alone(
    rows: Path, stays: Listening, serve: Callable[..., Listening]
) -> None:
    """Those on the others go on, while it is found to be lost and after that."""
    goes = serve("goes")
    places = [stays.sandbox(), goes.sandbox()]
    with started(rows, 4, sandbox=places, num_workers=4, min_ready=1) as env:
        workers = env.sandbox.stats()["workers"]
        lost = [index for index in range(4) if workers[index]["place"] == goes.endpoint]
        others = [index for index in range(4) if index not in lost]
        env.send(np.where(np.isin(np.arange(4), lost), 90, 0))
        goes.process.kill()
        seen, errors = dict.fromkeys(others, 0), set()
        while min(seen.values()) < STEPS or len(errors) < len(lost):
            try:
                received = env.recv()
            except WorkerDiedError as error:
                errors.update(error.env_ids)
                continue
            for row in received.observations:
                seen[int(row[0])] += 1
                assert row[1] == seen[int(row[0])]
            env.send(np.zeros(len(received.env_ids), np.int64), received.env_ids)
        assert errors == set(lost)


def test_a_silent_server_keeps_nobody_waiting(
    rows: Path, stays: Listening, serve: Callable[..., Listening]
) -> None:
    """It takes what it is sent, and says nothing; its row alone is late."""
    places = [stays.sandbox(), (silent := serve("silent")).sandbox()]
    with started(rows, 2, sandbox=places, num_workers=2, min_ready=1) as env:
        at = [worker["place"] for worker in env.sandbox.stats()["workers"]]
        quiet = at.index(silent.endpoint)
        late: list[WorkerTimeoutError] = []
        with inside.hurried_part(env, quiet, step_s=4.0), halted([silent.process.pid]):
            env.send(np.zeros(2, np.int64))
            while not late:
                try:
                    received = env.recv()
                except WorkerTimeoutError as error:
                    late.append(error)
                    break
                assert received.env_ids.tolist() == [1 - quiet]
                env.send(np.zeros(1, np.int64), received.env_ids)
        assert late[0].env_ids == (quiet,)


def test_a_learner_may_think_past_a_heartbeat(rows: Path, servers: list[Listening]) -> None:
    place = servers[0].sandbox(heartbeat_s=1.0)

    def thinks() -> None:
        with started(rows, 2, sandbox=place, min_ready=2) as env:
            env.send(np.zeros(2, np.int64))
            threading.Event().wait(4)
            assert env.recv().observations[:, 1].tolist() == [1, 1]

    # a machine that takes its core from the server for so long does lose a connection
    for _ in range(9):
        with contextlib.suppress(WorkerDiedError):
            thinks()
            return
    thinks()

"""A server without room says so as data, and clients that are told to wait do so in order."""

import logging
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError, ServerBusyError, WorkerError
from envhub_sandbox.extras.remote.sandbox import RemoteSandbox
from envhub_worker.extras.access import keys
from envhub_worker.protocol import messages as m
from tests.remote.listening import Listening, listening
from tests.remote.peers import peer
from tests.support.processes import eventually
from tests.support.started import started


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    with listening(tmp_path_factory.mktemp("narrow"), "--max-jails", "1") as server:
        yield server


def test_a_full_server_says_which_quota_and_how_much(narrow: Listening, repository: Path) -> None:
    """As attributes, also after ``retry_s``; what would never fit is another error, for which no
    waiting helps."""
    with started(repository, sandbox=narrow.sandbox()) as first:
        with pytest.raises(ServerBusyError, match=r"2 jails .* \(--max-jails\)") as caught:
            make_env(repository, n_envs=2, sandbox=narrow.sandbox())
        said = caught.value
        assert (said.quota, said.used, said.limit) == ("jails", 1, 1)
        assert said.retry_s > 0
        with pytest.raises(ServerBusyError):
            make_env(repository, n_envs=4, sandbox=narrow.sandbox(retry_s=1.5))
        assert first.step(np.array([0]))[0].tolist() == [[1.0]]
    policy = {"limits": {"memory_bytes": 1 << 50}}
    with pytest.raises(WorkerError) as never:
        make_env(repository, n_envs=3, sandbox=narrow.sandbox(retry_s=60.0), policy=policy)
    assert type(never.value) is WorkerError


def test_who_waits_gets_the_place_once_it_is_free(
    narrow: Listening, repository: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With a notice, for a new repository and for a known one; nothing else has changed."""
    sandbox = narrow.sandbox(retry_s=300.0)
    for seed in (1, 2):
        first = make_env(repository, sandbox=narrow.sandbox())
        first.env.reset(seed=seed)
        made = list[Any]()

        def make(into: list[Any] = made) -> None:
            suites = make_env(repository, n_envs=3, sandbox=sandbox)
            suites.env.reset(seed=1)
            into.append(suites)

        caplog.clear()
        with caplog.at_level(logging.WARNING, "envhub_sandbox.worker"):
            waiting = threading.Thread(target=make)
            waiting.start()
            assert eventually(lambda: "waiting for up to" in caplog.text)
            assert not made
            assert first.env.step(np.array([0]))[0].tolist() == [[1.0]]
            first.close()
            waiting.join(120)
        assert made[0].env.step(np.zeros(3, int))[0].tolist() == [[1.0]] * 3
        made[0].close()


def test_a_session_is_waited_for_like_a_jail(tmp_path: Path) -> None:
    """The refusal names that quota; who asks again is let in once the other has gone."""
    with listening(tmp_path / "server", "--max-sessions", "1") as server:
        pair = keys.load(server.state / "client.key")
        with peer(server, pair) as waiting:
            with peer(server, pair) as first:
                assert isinstance(first.ask(m.Hello(m.VERSION, b"first")), m.Welcome)
                refused = waiting.refused(m.Hello(m.VERSION, b"waiting"))
                assert (refused.error, refused.missing) == ("ServerBusyError", "sessions")
                assert refused.busy.used == 1
            hello = m.Hello(m.VERSION, b"waiting")
            assert eventually(lambda: isinstance(waiting.ask(hello), m.Welcome))


@pytest.mark.parametrize("retry_s", [-1.0, float("inf"), float("nan")])
def test_a_wait_without_end_is_refused(retry_s: float) -> None:
    with pytest.raises(PolicyError, match="retry_s"):
        RemoteSandbox("tcp://127.0.0.1:5555", retry_s=retry_s)

"""A server of a fleet goes: its rows come back elsewhere, or an error says which they are."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox.errors import LocalProtocolError, WorkerDiedError, WorkerTimeoutError
from envhub_worker.protocol import messages as m
from tests.integration.fleet.conftest import DIES, places
from tests.remote.hosts import OtherHost, other_host
from tests.remote.listening import Listening
from tests.support import inside
from tests.support.ports import lasting_port
from tests.support.processes import eventually
from tests.support.repositories import write_repository
from tests.support.started import started

STILL = np.zeros(6, np.int64)
Serve = Callable[..., Listening]


def _is_at(env: Any, server: Listening) -> np.ndarray:
    found = np.zeros(env.num_envs, bool)
    for worker in env.sandbox.stats()["workers"]:
        found[slice(*worker["rows"])] = worker["place"] == server.endpoint
    return found


def test_a_lost_server_costs_what_restart_says(rows: Path, stays: Listening, serve: Serve) -> None:
    """Its rows come back elsewhere, in the next step or with the reset after an error that names
    place and rows. Without restarts it stays dead; what to do is said, and nothing is left."""
    goes = serve("goes")

    def made(restart: str, workers: int) -> Any:
        sandbox, policy = [stays.sandbox(), goes.sandbox()], {"restart": restart}
        return started(rows, 6, sandbox=sandbox, seed=7, num_workers=workers, policy=policy)

    with made("transparent", 4) as env, made("on_reset", 2) as other, made("never", 2) as dead:
        env.set_attr("gain", [float(row) for row in range(6)])
        env.step(STILL)
        lost = _is_at(env, goes)
        assert lost.sum() == 3
        expected = other.reset(seed=5)[0]
        goes.process.kill()
        observations, rewards, terminations, truncations, infos = env.step(STILL)
        assert truncations.tolist() == lost.tolist()
        assert not terminations.any()
        assert infos["worker_restarted"].tolist() == lost.tolist()
        assert infos["row"].tolist() == list(range(6))
        assert observations[:, 0].tolist() == list(range(6))
        assert observations[:, 1].tolist() == np.where(lost, 0, 2).tolist()
        assert rewards.tolist() == np.where(lost, 0, range(6)).tolist()
        assert set(places(env)) == {stays.endpoint}
        env.step(STILL)  # in which the truncated rows are reset, as after any episode
        observations, rewards, *_ = env.step(STILL)
        assert observations[:, 1].tolist() == np.where(lost, 1, 4).tolist()
        assert rewards.tolist() == list(range(6)), "attributes were set again"
        numbers = env.sandbox.stats()
        assert (numbers["deaths"], numbers["restarts"]) == (2, 2)

        where = rf"\(sub-environments \d to \d of 6, on {goes.endpoint}\)"
        with pytest.raises(WorkerDiedError, match=where):
            other.step(STILL)
        with pytest.raises(WorkerDiedError, match=rf"call reset\(\) first {where}"):
            other.step(STILL)
        assert np.array_equal(other.reset(seed=5)[0], expected)
        assert places(other) == [stays.endpoint] * 2
        other.step(STILL)

        with pytest.raises(WorkerDiedError, match=rf"was lost .*on {goes.endpoint}"):
            dead.step(STILL)
        with pytest.raises(WorkerDiedError, match=r"make the environment again.*of 6, on tcp"):
            dead.reset()
        assert inside.state(dead).name == "DEAD"
    assert eventually(lambda: stays.jails() == 0)


def test_every_worker_is_waited_for_where_one_fails(rows: Path, servers: list[Listening]) -> None:
    """The one that fails first is not the end of the step: no other owes an answer afterwards."""
    sandbox = [server.sandbox() for server in servers]
    options: dict[str, Any] = {"n_envs": 6, "policy": {"restart": "on_reset"}}
    with started(rows, sandbox=sandbox, **options) as env:
        actions = np.array([DIES, 0, 0, 0, 50, 50])
        with pytest.raises(WorkerDiedError, match="sub-environments 0 to 1 of 6"):
            env.step(actions)
        states = [part.lifecycle.state.name for part in inside.parts(env)]
        assert states == ["DEAD", "READY", "READY"]
        expected = env.reset(seed=9)[0]
        assert np.array_equal(env.reset(seed=9)[0], expected)
        assert env.sandbox.stats()["stale_replies"] == 0


_TEXTS = """
import gymnasium as gym

class Texts(gym.Env):
    observation_space = gym.spaces.Discrete(100)
    action_space = gym.spaces.Sequence(gym.spaces.Text(8))

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return 0, {}

    def step(self, action):
        self.count += 1
        return self.count, 0.0, False, False, {}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Texts] * n_envs)
"""


def test_an_action_that_cannot_be_sent_is_sent_to_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named by the row that it is for, and all go on where they were. What has no layout is
    packed once, for its worker; a history of requests, which is off here, packs what it keeps."""
    folder = write_repository(tmp_path / "texts", _TEXTS)
    packed, pack = [], m.pack

    def noting(message: m.Message, **options: Any) -> Any:
        packed.append(type(message))
        return pack(message, **options)

    options: Any = {"sandbox": ["process", "process"], "policy": {"crash_history": 0}}
    with started(folder, n_envs=2, **options) as env:
        with pytest.raises(LocalProtocolError, match=r"actions\[1\]\[0\] cannot be sent"):
            env.step((("a",), ("x" * (5 << 20),)))
        monkeypatch.setattr(m, "pack", noting)
        assert env.step((("a",), ("b",)))[0].tolist() == [1, 1]
        assert env.step((("c",), ("d",)))[0].tolist() == [2, 2]
    assert packed.count(m.Step) == 4


def test_all_workers_share_one_timeout(rows: Path, servers: list[Listening]) -> None:
    """Three that are late are no later than one; reset() catches up with them all."""
    sandbox = [server.sandbox() for server in servers]
    with started(rows, n_envs=6, sandbox=sandbox) as env:
        expected = env.reset(seed=2)[0]
        late = r"step has not finished after 0.5 s .*sub-environments \d to \d of 6, on tcp"
        with inside.hurried(env, step_s=0.5), pytest.raises(WorkerTimeoutError, match=late):
            env.step(np.full(6, 60))
        assert {part.lifecycle.state.name for part in inside.parts(env)} == {"LATE"}
        with pytest.raises(WorkerTimeoutError, match="call reset"):
            env.step(STILL)
        assert np.array_equal(env.reset(seed=2)[0], expected)
        assert env.step(STILL)[0][:, 1].tolist() == [1] * 6


def test_a_server_that_comes_back_gets_workers_again(
    rows: Path, stays: Listening, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the same address, with the same key: the next workers that start go there, too."""
    monkeypatch.setattr("envhub_sandbox.extras.remote.tcp.CONNECT_S", 2.0)
    bind = f"tcp://127.0.0.1:{lasting_port()}"
    goes = serve("goes", bind=bind)
    sandbox = [stays.sandbox(), goes.sandbox()]
    options: dict[str, Any] = {"n_envs": 2, "policy": {"restart": "on_reset"}}
    with started(rows, sandbox=sandbox, **options) as env:
        goes.process.kill()
        goes.process.wait()
        with pytest.raises(WorkerDiedError):
            env.step(STILL[:2])
        env.reset(seed=1)
        assert places(env) == [stays.endpoint] * 2
        serve("goes", bind=bind)
        with started(rows, sandbox=sandbox, **options) as other:
            assert sorted(places(other)) == sorted([stays.endpoint, goes.endpoint])


@pytest.fixture
def far() -> Iterator[OtherHost]:
    with other_host() as host:
        yield host


def test_a_partition_moves_rows(rows: Path, far: OtherHost, stays: Listening, serve: Serve) -> None:
    """A cable is out: the heartbeat says so, and the rows come back here; there nothing remains."""
    bind = f"tcp://{far.address}:5555"
    there = serve("there", "--idle-s", "10", bind=bind, prefix=far.prefix)
    sandbox = [stays.sandbox(), there.sandbox(heartbeat_s=3.0)]
    options: dict[str, Any] = {"n_envs": 6, "policy": {"restart": "transparent"}}
    with started(rows, sandbox=sandbox, **options) as env:
        lost = _is_at(env, there)
        far.unplug()
        observations, *_, truncations, _ = env.step(STILL)
        assert truncations.tolist() == lost.tolist()
        assert observations[:, 1].tolist() == np.where(lost, 0, 1).tolist()
        assert set(places(env)) == {stays.endpoint}
        far.plug()
        assert env.step(STILL)[0][:, 1].tolist() == np.where(lost, 0, 2).tolist()
        assert eventually(lambda: there.jails() == 0), "the client names its jails no longer"

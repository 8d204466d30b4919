"""Which worker goes where, and to the next place where one has no room."""

from __future__ import annotations

import json
import pickle
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import Fleet, make_env
from envhub_sandbox.errors import PolicyError, ServerBusyError, WorkerDiedError
from tests.integration.fleet.conftest import places
from tests.remote.listening import Listening
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.ports import lasting_port
from tests.support.processes import eventually
from tests.support.samples import sample
from tests.support.started import started


def test_workers_are_spread_over_all_places(rows: Path, servers: list[Listening]) -> None:
    """As many on each as it goes; a place that is named twice gets twice as many."""
    a, b, c = (server.sandbox() for server in servers)
    with started(rows, n_envs=9, sandbox=[a, b, c, a], num_workers=8) as env:
        assert Counter(places(env)) == {a.endpoint: 4, b.endpoint: 2, c.endpoint: 2}
        assert env.step(np.zeros(9, int))[0][:, 0].tolist() == list(range(9))
        assert [server.jails() for server in servers] == [4, 2, 2]
    assert all(eventually(lambda s=server: s.jails() == 0) for server in servers)


def test_a_full_server_is_followed_by_the_next(
    rows: Path, servers: list[Listening], serve: Callable[..., Listening]
) -> None:
    """By the word of the server, and where that was too old by its refusal."""
    small = serve("small", "--max-jails", "1")
    sandboxes = [small.sandbox(), servers[0].sandbox()]
    with started(rows, n_envs=4, sandbox=sandboxes, num_workers=4) as env:
        assert sorted(Counter(places(env)).values()) == [1, 3]
        assert small.jails() == 1
        env.step(np.zeros(4, int))


def test_no_room_anywhere_is_an_error_that_names_all(
    rows: Path, serve: Callable[..., Listening]
) -> None:
    """It is the one for which one may wait; nothing is left open of the workers that had room."""
    small = [serve(name, "--max-jails", "1") for name in ("one", "two")]
    with make_env(rows, n_envs=3, sandbox=[s.sandbox() for s in small], num_workers=3) as suites:
        with pytest.raises(ServerBusyError, match="quota of 1") as caught:
            suites.env.reset()
        assert "The other places of the fleet" in str(caught.value)
        assert "of 3, on tcp://" in str(caught.value)
    assert all(eventually(lambda s=server: s.jails() == 0) for server in small)


def test_one_waits_for_room_where_asked_to(rows: Path, serve: Callable[..., Listening]) -> None:
    """``retry_s`` holds for the fleet as for one server."""
    small = serve("small", "--max-jails", "2")
    sandboxes = [small.sandbox(retry_s=120)]
    with make_env(rows, n_envs=2, sandbox=sandboxes, num_workers=2) as suites:
        suites.env.reset()
        inside.parts(suites.env)[0].lease.end()  # makes room while the other one waits
        with started(rows, n_envs=2, sandbox=[*sandboxes, *sandboxes], num_workers=1) as other:
            other.step(np.zeros(2, int))


def test_a_server_that_is_not_there_gets_no_worker(rows: Path, servers: list[Listening]) -> None:
    """Nor does one that does not let us in, as long as others have room."""
    here = servers[0].sandbox()
    absent = servers[0].sandbox(endpoint=f"tcp://127.0.0.1:{lasting_port()}")
    stranger = servers[1].sandbox(client_key="f" * 64)
    with started(rows, n_envs=4, sandbox=[absent, stranger, here], num_workers=4) as env:
        assert set(places(env)) == {here.endpoint}


def test_a_list_in_a_file_is_looked_at_again(
    rows: Path, serve: Callable[..., Listening], client_key: Path, tmp_path: Path
) -> None:
    """A server that is added gets workers that are brought back, one that has gone gets none."""
    listed = tmp_path / "places"
    first, second = serve("first"), serve("second")

    def write(*wanted: Listening) -> None:
        lines = [f"{server.endpoint} {server.public}  # a comment" for server in wanted]
        listed.write_text("\n".join(["# places", "", *lines]))

    write(first)
    fleet = Fleet(listed, remote={"client_key": client_key})
    options: dict[str, Any] = {"n_envs": 2, "num_workers": 2, "policy": {"restart": "on_reset"}}
    with started(rows, sandbox=fleet, **options) as env:
        assert places(env) == [first.endpoint] * 2
        write(second)
        inside.parts(env)[1].lease.end()
        with pytest.raises(WorkerDiedError, match="sub-environment 1 of 2"):
            env.step(np.zeros(2, int))
        env.reset(seed=1)
        assert places(env) == [first.endpoint, second.endpoint]
        listed.unlink()  # the last known places hold
        inside.parts(env)[0].lease.end()
        with pytest.raises(WorkerDiedError):
            env.step(np.zeros(2, int))
        env.reset(seed=1)
        assert places(env) == [second.endpoint] * 2


def test_the_provenance_says_where_they_run(rows: Path, servers: list[Listening]) -> None:
    """With the environment's own results the same: it is said beside them."""
    sandboxes = [servers[0].sandbox(), "process"]
    with make_env(rows, n_envs=2, sandbox=sandboxes) as suites:
        suites.env.reset()
        assert sorted(suites.provenance["places"]) == ["process", servers[0].endpoint]
        json.dumps(suites.provenance)


def test_what_cannot_be_cut_has_one_worker(servers: list[Listening]) -> None:
    """A vector environment that steps by a class of its own is somewhere, as a whole."""
    sandbox = [server.sandbox() for server in servers]
    with make_env(sample("custom_vector"), n_envs=4, sandbox=sandbox) as suites:
        with make_env(sample("custom_vector"), n_envs=4) as alone:
            assert_same(alone.env.reset(seed=3), suites.env.reset(seed=3), "reset")
            actions = alone.env.action_space.sample()
            assert_same(alone.env.step(actions), suites.env.step(actions), "step")
        assert "workers" not in suites.env.sandbox.stats()
        assert sum(server.jails() for server in servers) == 1


def test_a_fleet_can_be_handed_on(rows: Path) -> None:
    """A pickle of its environments makes them again, over places of the same names."""
    with make_env(rows, n_envs=3, sandbox=Fleet(["process"] * 3)) as suites:
        expected = suites.env.reset(seed=4)[0]
        with pickle.loads(pickle.dumps(suites)) as again:
            assert len(inside.parts(again.env)) == 3
            assert np.array_equal(expected, again.env.reset(seed=4)[0])


def test_no_secret_key_is_in_a_pickle() -> None:
    """Neither the fleet's own nor one of its places'."""
    secret = "0123456789abcdef" * 4
    fleet = Fleet(["tcp://a:1", "tcp://b:1"], remote={"client_key": secret, "server_key": "f" * 64})
    assert secret.encode() not in pickle.dumps(fleet)
    assert secret not in repr(fleet)


@pytest.mark.parametrize("places", [[], "file:/there/is/none", "dns://nohost", ["process", "vm"]])
def test_a_list_that_is_none_is_refused(rows: Path, places: Any) -> None:
    """Before anything is started."""
    with pytest.raises(PolicyError):
        make_env(rows, sandbox=Fleet(places) if places != "file:/there/is/none" else places)

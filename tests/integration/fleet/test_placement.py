"""Which worker goes where, to the next place where one has no room; and with which packages."""

import json
import pickle
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest

from envhub_sandbox import Fleet, make_env
from envhub_sandbox.errors import ServerBusyError
from tests.integration.fleet.conftest import places, serving
from tests.remote.listening import Listening
from tests.support import inside
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, make_wheel
from tests.support.ports import lasting_port
from tests.support.processes import eventually, halted
from tests.support.repositories import importing, write_repository
from tests.support.samples import sample
from tests.support.started import started


def test_workers_are_spread_over_all_places(rows: Path, servers: list[Listening]) -> None:
    """As many on each as it goes; a place that is named twice gets twice as many."""
    a, b, c = (server.sandbox() for server in servers)
    with started(rows, n_envs=9, sandbox=[a, b, c, a], num_workers=8) as env:
        assert Counter(places(env)) == {a.endpoint: 4, b.endpoint: 2, c.endpoint: 2}
        assert env.step(np.zeros(9, int))[0][:, 0].tolist() == list(range(9))
        # an earlier test's may still be on their way out
        assert eventually(lambda: [server.jails() for server in servers] == [4, 2, 2])
    # a vector environment that steps by a class of its own is somewhere, as a whole
    with make_env(sample("custom_vector"), n_envs=4, sandbox=[a, b, c]) as suites:
        suites.env.reset(seed=3)
        assert "workers" not in suites.env.sandbox.stats()
        assert eventually(lambda: sum(server.jails() for server in servers) == 1)
    assert all(eventually(lambda s=server: s.jails() == 0) for server in servers)


def test_a_full_server_is_followed_by_the_next(
    rows: Path, servers: list[Listening], serve: Callable[..., Listening]
) -> None:
    """By the word of the server, and where that was too old by its refusal. No room anywhere is the
    error for which one may wait: nothing is left open of the workers that had room."""
    small = [serve(name, "--max-jails", "1") for name in ("one", "two")]
    with make_env(rows, n_envs=3, sandbox=[s.sandbox() for s in small], num_workers=3) as suites:
        with pytest.raises(ServerBusyError, match="quota of 1") as caught:
            suites.env.reset()
        assert "The other places of the fleet" in str(caught.value)
        assert "of 3, on tcp://" in str(caught.value)
    assert all(eventually(lambda s=server: s.jails() == 0) for server in small)
    sandboxes = [small[0].sandbox(), servers[0].sandbox()]
    with started(rows, n_envs=4, sandbox=sandboxes, num_workers=4) as env:
        assert (sorted(Counter(places(env)).values()), small[0].jails()) == ([1, 3], 1)
        env.step(np.zeros(4, int))


def test_a_server_that_is_not_there_gets_no_worker(rows: Path, servers: list[Listening]) -> None:
    """Nor does one that does not let us in, as long as others have room."""
    here = servers[0].sandbox()
    absent = servers[0].sandbox(endpoint=f"tcp://127.0.0.1:{lasting_port()}")
    stranger = servers[1].sandbox(client_key="f" * 64)
    with started(rows, n_envs=4, sandbox=[absent, stranger, here], num_workers=4) as env:
        assert set(places(env)) == {here.endpoint}


def test_a_server_that_opens_no_jail_leaves_time_for_the_next(
    rows: Path, stays: Listening, serve: Callable[..., Listening], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says that it has room, and what would make the jail does nothing."""
    stuck = serve("stuck")
    with started(rows, sandbox=stuck.sandbox()):
        pass
    assert eventually(lambda: stuck.jails() == 0)
    server = psutil.Process(stuck.process.pid)
    monkeypatch.setattr(*inside.SHARE_OF_A_SERVER, 0.01)
    with (
        halted(zygote.pid for zygote in server.children()),
        halted(one.pid for one in server.children(recursive=True)),  # what it has prepared
        started(rows, sandbox=[stuck.sandbox(), stays.sandbox()], n_envs=2) as env,
    ):
        assert places(env) == [stays.endpoint] * 2


def test_a_fleet_can_be_handed_on(rows: Path) -> None:
    """The provenance names the places; a pickle of its environments makes them again, over places
    of the same names."""
    with make_env(rows, n_envs=3, sandbox=Fleet(["process"] * 3)) as suites:
        expected = suites.env.reset(seed=4)[0]
        assert set(suites.provenance["places"]) == {"process"}
        json.dumps(suites.provenance)
        with pickle.loads(pickle.dumps(suites)) as again:
            assert len(inside.parts(again.env)) == 3
            assert np.array_equal(expected, again.env.reset(seed=4)[0])


ENV = importing("listed", where="listed.__file__")


@pytest.fixture(scope="module")
def packages(real_index: Index) -> Index:
    """An index with a package that is installed nowhere."""
    make_wheel(real_index.folder, "listed", "1.0")
    return real_index


def test_here_and_on_a_server(packages: Index, client_key: Path, tmp_path: Path) -> None:
    """Each place makes them itself; the results are those of one."""
    folder = write_repository(tmp_path / "repository", ENV, requirements__txt="listed\n")
    with make_env(folder, n_envs=4) as suites:
        expected = suites.env.reset(seed=3)[0]
    with (
        serving(tmp_path / "server", client_key, "--dependencies") as server,
        make_env(folder, n_envs=4, sandbox=["process", server.sandbox()]) as suites,
    ):
        assert np.array_equal(suites.env.reset(seed=3)[0], expected)
        assert sorted(places(suites.env)) == sorted(["process", server.endpoint])
        where = suites.env.call("where")
        assert len(set(where)) == 2
        assert "listed==1.0" in suites.provenance["installed"]["packages"]


def test_a_place_that_lacks_one(packages: Index, stays: Listening, tmp_path: Path) -> None:
    """A server that makes none has its own packages: the error says which rows and which place."""
    folder = write_repository(tmp_path / "repository", ENV, requirements__txt="listed\n")
    with (
        make_env(folder, n_envs=4, sandbox=["process", stays.sandbox()]) as suites,
        refused_dependency("module", match="No module named 'listed'") as caught,
    ):
        suites.env.reset()
    assert f"of 4, on {stays.endpoint}" in str(caught.value)

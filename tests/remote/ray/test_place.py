"""``sandbox="ray"``: a worker server where Ray places it, with the results of any other place."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from envhub_sandbox import RaySandbox, make_env
from envhub_sandbox.errors import PolicyError, ServerBusyError
from envhub_sandbox.extras.remote import repository as remote_repository
from envhub_sandbox.sandboxes.pool import stop_idle
from tests.compliance.conftest import pytest_generate_tests as pytest_generate_tests
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, paired
from tests.remote import test_parity
from tests.remote.listening import counting
from tests.remote.ray.clusters import node_of, only_server, servers
from tests.support.command_line import below, gone
from tests.support.processes import eventually
from tests.support.samples import sample
from tests.support.started import started

ray = pytest.importorskip("ray")
AT_ONCE = {"server_idle_s": 0.0}


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository whose observation is the number of its steps."""
    return counting(tmp_path / "repository", files={"large.bin": os.urandom(300_000)})


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, cluster: Any) -> Iterator[Pair]:
    with paired(request.cls.sample, case, sandbox=RaySandbox(num_cpus=1)) as both:
        yield both


@pytest.mark.short
class TestCounter(test_parity.TestCounter):
    """On a node, over two processes of it."""


class TestLeRobotPendulum(test_parity.TestLeRobotPendulum):
    """On a node."""


@pytest.mark.short
def test_an_actor_is_where_ray_places_it(cluster: Any, repository: Path) -> None:
    """By the resources that it asks for, which it holds for as long as it lives."""
    nodes = {one["NodeID"]: one["Resources"] for one in ray.nodes()}
    for resource in ("one", "two"):
        place = RaySandbox(num_cpus=1.5, resources={resource: 8})
        with make_env(repository, sandbox=place, timeouts=AT_ONCE) as suites:
            suites.env.reset(seed=0)
            assert suites.env.step(np.array([0]))[0].tolist() == [[1.0]]
            server = only_server()
            assert resource in nodes[node_of(server)]
            assert suites.provenance["places"] == [f"Ray's node {node_of(server)[:12]}"]
            # a node tells the head of it a moment later
            assert eventually(lambda wanted=resource: wanted not in ray.available_resources())
            left = below(server.pid)
            assert left
        assert eventually(lambda left=left: gone(left) and not servers())
        assert eventually(lambda wanted=resource: ray.available_resources().get(wanted) == 8)


@pytest.mark.short
def test_a_node_is_sent_once(
    cluster: Any, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Servers on one node share what was verified here and brought there; another node has none."""
    sent = []

    def upload_counted(*arguments: Any) -> tuple[str, int]:
        done = original(*arguments)
        sent.append(done[1])
        return done

    original = remote_repository.upload
    monkeypatch.setattr(remote_repository, "upload", upload_counted)
    place = RaySandbox(resources={"one": 1})
    options = {"sandbox": place, "timeouts": AT_ONCE}
    with started(repository, **options) as env, started(repository, **options) as other:
        assert eventually(lambda: len(servers()) == 2)
        assert env.step(np.array([0]))[0].tolist() == other.step(np.array([0]))[0].tolist()
    assert sent[0] >= 300_000
    assert sent[1:] == [0]
    node = Path(os.environ["ENVHUB_CACHE"], "ray")
    there = [one.read_bytes() for one in node.glob("store/shared/trees/*/large.bin")]
    assert there.count((repository / "large.bin").read_bytes()) == 1
    assert not list(node.rglob("*.key"))


@pytest.mark.short
def test_what_no_node_has_room_for_is_told(cluster: Any, repository: Path) -> None:
    """With what is free; nothing is left that would be started later."""
    stop_idle()
    assert eventually(lambda: ray.available_resources().get("CPU") == 4)
    with pytest.raises(ServerBusyError, match="no worker server within 3 s") as caught:
        make_env(repository, sandbox=RaySandbox(num_cpus=64, placement_s=3))
    assert caught.value.quota == "cluster"
    assert "'CPU': 4" in str(caught.value)
    for place in (RaySandbox(num_cpus=2, resources={"one": 1}), RaySandbox(resources={"one": 1})):
        with started(repository, sandbox=place) as env:  # an idle one makes room for the next
            assert env.step(np.array([0]))[0].tolist() == [[1.0]]
            assert only_server()


def test_another_address_than_this_process_has_is_refused(cluster: Any, repository: Path) -> None:
    """It would be two clusters at once; the same one may be named."""
    with pytest.raises(PolicyError, match=r"ray\.shutdown"):
        make_env(repository, sandbox=RaySandbox(address="10.0.0.1:6379"))
    with started(repository, sandbox=RaySandbox(address=cluster.address)) as env:
        assert env.step(np.array([0]))[0].tolist() == [[1.0]]


def test_a_suite_keeps_its_server_between_its_tasks(cluster: Any) -> None:
    stop_idle()
    assert eventually(lambda: not servers())
    with make_env(sample("many_tasks"), sandbox="ray", timeouts={"server_idle_s": 0.1}) as suites:
        seen = set()
        for env in list(next(iter(suites.values())).values())[:2]:
            env.reset(seed=0)
            seen |= {one.pid for one in servers()}
            env.close()
        assert len(seen) == 1
    assert eventually(lambda: not servers())


def test_nothing_of_rays_reaches_the_server(
    cluster: Any, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No variable of the node's but those for packages; and no secret key is on a command line."""
    place = RaySandbox(runtime_env={"env_vars": {"RAY_AUTH_TOKEN": "secret", "SECRET": "secret"}})
    with started(repository, sandbox=place):
        server = only_server()
        assert "SECRET" in psutil.Process(server.ppid()).environ()  # the control
        variables = server.environ()
        assert not [one for one in variables if "RAY" in one or "SECRET" in one]

"""One environment over several nodes: what one place gives, and only the rows of a lost one end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import RaySandbox
from tests.compliance.conftest import pytest_generate_tests as pytest_generate_tests
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance, paired
from tests.faults.mortal import LIVE
from tests.remote.ray.clusters import add_node, node_of, servers
from tests.support.processes import eventually
from tests.support.samples import sample
from tests.support.started import started

ray = pytest.importorskip("ray")
AT_ONCE = {"server_idle_s": 0.0}


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, cluster: Any) -> Iterator[Pair]:
    """The reference, and an environment over as many servers as it has workers."""
    places = [RaySandbox(num_cpus=0.5)] * (case.num_workers or 1)
    with paired(request.cls.sample, case, sandbox=places) as both:
        yield both


@pytest.mark.short
class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos; five rows over three servers."""

    sample = "counter"
    cases = (Case(5, False, {"autoreset_mode": "NextStep"}, 3),)
    steps = 60


def test_a_lost_node_loses_its_rows_alone(cluster: Any) -> None:
    """Of four nodes behind one environment; they begin anew on another, the others go on."""
    more = [add_node(cluster, num_cpus=2, place=1) for _ in range(4)]
    places = [RaySandbox(num_cpus=1, resources={"place": 1}, placement_s=60)] * 4
    policy = {"restart": "transparent", "crash_history": 0}
    options = {"n_envs": 8, "sandbox": places, "policy": policy, "timeouts": AT_ONCE}
    with started(sample("mortal"), **options) as env:
        assert eventually(lambda: len(servers()) == 4)
        assert {node_of(one) for one in servers()} == {one.node_id for one in more}
        assert env.step([LIVE] * 8)[0][:, 1].tolist() == [1.0] * 8
        spare = add_node(cluster, num_cpus=2, place=1)
        lost = more.pop()
        cluster.remove_node(lost, allow_graceful=False)
        assert eventually(lambda: len(servers()) == 3)
        observations, _, _, truncations, infos = env.step([LIVE] * 8)
        assert truncations.sum() == 2
        assert np.array_equal(infos["worker_restarted"], truncations)
        assert observations[:, 1].tolist() == [0.0 if one else 2.0 for one in truncations]
        assert {node_of(one) for one in servers()} == {one.node_id for one in (*more, spare)}
    assert eventually(lambda: not servers())
    for node in (*more, spare):
        cluster.remove_node(node)

"""One environment over several nodes: what one place gives, and only the rows of a lost one end."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import RaySandbox
from envhub_sandbox.errors import WorkerDiedError
from tests.compliance.conftest import pytest_generate_tests as pytest_generate_tests
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance, paired
from tests.faults.mortal import LIVE
from tests.remote.ray.clusters import add_node, node_of, servers
from tests.support.command_line import below, gone
from tests.support.processes import eventually
from tests.support.samples import reference, sample
from tests.support.started import started

ray = pytest.importorskip("ray")
AT_ONCE = {"server_idle_s": 0.0}
ROWS, WORKERS = 64, 8


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, cluster: Any) -> Iterator[Pair]:
    """The reference, and an environment over as many servers as it has workers."""
    with paired(request.cls.sample, case, sandbox=RaySandbox(num_cpus=0.5)) as both:
        yield both


@pytest.mark.short
class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos; five rows over three servers."""

    sample = "counter"
    cases = (Case(5, False, {"autoreset_mode": "NextStep"}, 3),)
    steps = 60


@pytest.mark.short
def test_a_lost_node_loses_its_rows_alone(cluster: Any) -> None:
    """Ray spreads workers over the nodes, and one of these goes in the midst of an episode: what
    ``restart`` promises comes true, by ``num_workers`` and by a list of places. Ray counts what is
    held, and in the end nothing is."""
    nodes = {node.node_id: node for node in (add_node(cluster, 1, place=16) for _ in range(4))}
    place = RaySandbox(num_cpus=0.05, resources={"place": 1}, placement_s=60)
    workers = {"sandbox": place, "num_workers": WORKERS}
    listed = {"sandbox": [place] * 4}
    actions, oracle = [LIVE] * ROWS, reference("mortal", n_envs=ROWS)
    oracle.reset(seed=1)
    with started(**environment("transparent"), **workers) as env:
        spread = placed()
        assert set(spread) == set(nodes)
        with started(**environment("on_reset"), **listed) as other:
            assert eventually(lambda: free("place") == 4 * 16 - WORKERS - 4)
            expected = oracle.step(actions)
            assert results_equal(env.step(actions), expected)
            assert results_equal(other.step(actions), expected)
            victim, _ = (placed() - spread).most_common(1)[0]
            lost = [server for server in servers() if node_of(server) == victim]
            lost += [process for server in lost for process in below(server.pid)]
            cluster.remove_node(nodes.pop(victim), allow_graceful=False)
            assert eventually(lambda: gone(lost))
            expected = oracle.step(actions)
            with pytest.raises(WorkerDiedError, match=f"on Ray's node {victim[:12]}: Ray says"):
                other.step(actions)
            observations, rewards, _, anew, infos = env.step(actions)
            assert np.array_equal(infos["worker_restarted"], anew)
            assert anew.sum() == spread[victim] * ROWS // WORKERS
            assert not observations[anew, 1].any()
            assert np.array_equal(observations[~anew], expected[0][~anew])
            assert np.array_equal(rewards[~anew], expected[1][~anew])
            assert np.array_equal(other.reset(seed=5)[0], oracle.reset(seed=5)[0])
            assert results_equal(other.step(actions), oracle.step(actions))
            assert set(placed()) <= set(nodes)
            assert sum(placed().values()) == WORKERS + 4
    assert eventually(lambda: not servers())
    assert eventually(lambda: free("place") == 3 * 16)
    for node in nodes.values():
        cluster.remove_node(node)


def environment(restart: str) -> dict[str, Any]:
    policy = {"restart": restart, "crash_history": 0}
    return {"cfg": sample("mortal"), "n_envs": ROWS, "policy": policy, "timeouts": AT_ONCE}


def placed() -> Counter[str]:
    return Counter(map(node_of, servers()))


def free(resource: str) -> float | None:
    """What the cluster has left of it, as ``ray status`` says."""
    return ray.available_resources().get(resource)


def results_equal(results: tuple[Any, ...], expected: tuple[Any, ...]) -> bool:
    """All but the infos."""
    return all(map(np.array_equal, results[:4], expected[:4]))

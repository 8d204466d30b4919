"""Actors, nodes, drivers and the head end at any moment: nothing is left, and the error says so."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from envhub_sandbox import RaySandbox, make_env
from envhub_sandbox.errors import WorkerDiedError
from tests.remote.listening import counting
from tests.remote.ray.clusters import cluster_of, node_of, only_server, servers
from tests.support.command_line import below, gone, python
from tests.support.processes import eventually
from tests.support.started import started

ray = pytest.importorskip("ray")
AT_ONCE = {"server_idle_s": 0.0}
RESTARTS = {"restart": "on_reset", "crash_history": 0}
LIVES = np.array([0])
# makes environments on a cluster, says so, and steps for ever
DRIVER = """
import json, sys
import numpy as np
import ray
from envhub_sandbox import make_env

address, repository = sys.argv[1:]
if address:
    ray.init(address=address, log_to_driver=False)
env = make_env(repository, sandbox="ray", timeouts={"step_s": 60}).env
env.reset(seed=0)
print(json.dumps("made"), flush=True)
try:
    while True:
        env.step(np.array([0]))
except Exception as error:
    print(json.dumps(str(error)), flush=True)
"""


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository whose observation is the number of its steps."""
    return counting(tmp_path / "repository")


def server_alone() -> tuple[psutil.Process, list[psutil.Process]]:
    """The one server that there is, and all that is below it."""
    server = only_server()
    jails = below(server.pid)
    assert len(jails) > 1
    return server, jails


@pytest.mark.short
@pytest.mark.parametrize("victim", ["actor", "server"])
def test_a_killed_actor_leaves_nothing(cluster: Any, repository: Path, victim: str) -> None:
    """Nor does a killed server; the error says which, and a reset has another one."""
    with started(repository, sandbox=RaySandbox(), policy=RESTARTS, timeouts=AT_ONCE) as env:
        server, jails = server_alone()
        node = node_of(server)[:12]
        env.step(LIVES)
        os.kill(server.ppid() if victim == "actor" else server.pid, signal.SIGKILL)
        said = words_of_the_end(env)
        assert f"on Ray's node {node}:" in said
        assert ("Ray says: The actor died" if victim == "actor" else "it ended with -9") in said
        assert eventually(lambda: gone([server, *jails]))
        env.reset(seed=0)
        assert env.step(LIVES)[0].tolist() == [[1.0]]
        assert server_alone()[0].pid != server.pid
    assert eventually(lambda: not servers())


def words_of_the_end(env: Any) -> str:
    """Step until it has died; what the error says."""
    with pytest.raises(WorkerDiedError) as caught:  # noqa: PT012
        while True:
            env.step(LIVES)
    return str(caught.value)


@pytest.mark.short
def test_a_killed_driver_leaves_nothing(cluster: Any, repository: Path, tmp_path: Path) -> None:
    """By SIGKILL: nothing of it runs any more that could end anything."""
    driver = start_driver(cluster.address, repository)
    server, jails = server_alone()
    driver.kill()
    driver.wait(60)
    assert eventually(lambda: gone([server, *jails]))
    assert eventually(lambda: ray.available_resources().get("CPU") == 4)


def start_driver(address: str, repository: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", DRIVER, address, str(repository)]
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert json.loads(driver.stdout.readline()) == "made"
    return driver


def test_a_shutdown_of_ray_is_named(cluster: Any, repository: Path) -> None:
    """The environment is then lost; closing it takes no time, and a new connection serves again."""
    with make_env(repository, sandbox=RaySandbox(), policy=RESTARTS, timeouts=AT_ONCE) as suites:
        env = suites.env
        env.reset(seed=0)
        server, jails = server_alone()
        ray.shutdown()
        try:
            assert eventually(lambda: gone([server, *jails]))
            with pytest.raises(WorkerDiedError, match=r"ray\.shutdown\(\) was called"):
                env.step(LIVES)
        finally:
            ray.init(address=cluster.address, log_to_driver=False)
        env.reset(seed=0)
        assert env.step(LIVES)[0].tolist() == [[1.0]]
    assert eventually(lambda: not servers())


def test_a_lost_head_leaves_nothing(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes give up some time after their head has gone, and so do the drivers: Ray ends them."""
    monkeypatch.setenv("RAY_gcs_rpc_server_reconnect_timeout_s", "3")
    with cluster_of({}) as own:
        driver = start_driver(own.address, repository)
        server, jails = server_alone()
        own.head_node.kill_all_processes(check_alive=False, allow_graceful=False)
        [node] = own.worker_nodes
        # Ray takes a raylet for alive until its parent, this process, has asked for its end
        assert eventually(lambda: bool(node.dead_processes()), 180)
        assert eventually(lambda: gone([server, *jails]), 180)
        driver.kill()
        driver.wait(60)


def test_a_local_ray_is_started_and_said(repository: Path, tmp_path: Path) -> None:
    """Where nobody has called ``ray.init``; it ends with the process."""
    done = python("-c", LOCAL, repository, RAY_TMPDIR="/tmp/ray-none", RAY_ADDRESS="")
    assert (done.stdout.split(), done.stderr.count("a local Ray with")) == (["1"], 1)
    assert eventually(lambda: not servers())


LOCAL = """
import sys
import numpy as np
from envhub_sandbox import make_env

for _ in range(2):
    with make_env(sys.argv[1], sandbox="ray") as suites:
        suites.env.reset(seed=0)
        observation = suites.env.step(np.array([0]))[0]
print(int(observation.item()))
"""

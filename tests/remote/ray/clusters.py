"""A Ray cluster for tests, and what runs on its nodes as the kernel sees it."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import psutil
import pytest

from tests.support.processes import eventually

_SOON = {"health_check_period_ms": 1000, "health_check_failure_threshold": 4}
"""For Ray to see that a node has gone; by itself it takes three times as long."""
_TRIES = 8
MEMORY = 80 * 2**20
"""Of a node's object store, the least that Ray takes."""


@contextmanager
def cluster_of(*nodes: dict[str, Any]) -> Iterator[Any]:
    """A head, where nothing is placed by itself, and nodes with these resources.
    Yields Ray's own ``Cluster``; the process is not connected to it."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp")  # short: it holds sockets
    # Ray's Cluster writes its address below the default folder, which it does not make
    os.mkdir(os.path.join(folder, "ray"))
    found = Cluster()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
        try:
            own = {"temp_dir": folder, "include_dashboard": False, "_system_config": _SOON}
            _started(found, num_cpus=0, **own)
            for node in nodes:
                add_node(found, **node)
            yield found
        finally:
            found.shutdown()
            shutil.rmtree(folder, ignore_errors=True)


def add_node(cluster: Any, num_cpus: float = 2, **resources: float) -> Any:
    own = {"resources": resources} if resources else {}
    return _started(cluster, num_cpus=num_cpus, **own)


def _started(cluster: Any, **arguments: Any) -> Any:
    """A node. Ray gives it 30 s, and it gives its own agents half of that, which a machine whose
    cores are taken away may not have. What a try has left is ended: it would slow the next one."""
    for left in reversed(range(_TRIES)):
        before = psutil.Process().children(recursive=True)
        try:
            return cluster.add_node(object_store_memory=MEMORY, **arguments)
        except Exception as error:
            if "timed out during startup" not in str(error) or not left:
                raise
        for process in psutil.Process().children(recursive=True):
            if process not in before:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
    raise AssertionError


def servers() -> list[psutil.Process]:
    """The worker servers that actors have started with this run's cache, of whatever node."""
    state = os.path.join(os.environ["ENVHUB_CACHE"], "ray")
    found = []
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        if "--only-client" in words and state in words:
            found.append(process)
    return found


def only_server() -> psutil.Process:
    """The one server that there is, once those of earlier tests have ended: Ray ends an actor in
    its own time, and the server ends after that."""
    assert eventually(lambda: len(servers()) == 1), servers()
    [server] = servers()
    return server


def node_of(server: psutil.Process) -> str:
    """The id of the node that a server runs on, by the command line of its actor's raylet."""
    for process in server.parents():
        for word in process.cmdline():
            if word.startswith("--node_id="):
                return word.partition("=")[2]
    raise AssertionError(f"{server} is below no raylet")

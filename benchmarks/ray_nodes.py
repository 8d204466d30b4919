"""64 sub-environments over 4 Ray nodes of this machine, against one server of the same cores.

    python -m benchmarks.ray_nodes [--nodes 4] [--envs 64] [--rounds 15] [--seconds 1]

The nodes are ``ray.cluster_utils.Cluster``'s, each with a worker server that Ray has placed there;
the other side is one server on loopback with CURVE keys, with as many processes as there are nodes.
Rounds take turns, in changing order. Printed: the median of the rounds' ratios, and how much of the
processors' time the host has taken: rounds in which that was more than 2 % are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import clients
from benchmarks.load import stolen
from envhub_sandbox import RaySandbox, make_env

_REPOSITORIES = Path(__file__).parent / "repositories"
_MOST_STOLEN = 0.02


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--workloads", nargs="+", default=["cartpole", "busy"])
    arguments = parser.parse_args(argv)
    print("| workload | one server, steps/s | Ray nodes, steps/s | ratio | rounds |")
    print("|---|---|---|---|---|")
    with contextlib.ExitStack() as stack:
        stack.enter_context(_cluster(arguments.nodes))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        server = stack.enter_context(clients.Server(folder))
        places = {"one": server.sandbox(), "nodes": [RaySandbox()] * arguments.nodes}
        for workload in arguments.workloads:
            _compare(workload, places, arguments)
    return 0


def _compare(workload: str, places: dict[str, Any], arguments: argparse.Namespace) -> None:
    with contextlib.ExitStack() as stack:
        envs = {}
        for name, place in places.items():
            suites = make_env(
                _REPOSITORIES / workload,
                n_envs=arguments.envs,
                use_async_envs=name == "one",  # over processes of one jail
                num_workers=arguments.nodes,
                sandbox=place,
            )
            envs[name] = stack.enter_context(suites).env
            envs[name].reset(seed=0)
        found = []
        for _ in range(arguments.rounds):
            order = random.sample(list(envs), len(envs))
            before = stolen()
            rates = {name: _rate(envs[name], arguments.seconds) for name in order}
            taken, passed = (late - early for late, early in zip(stolen(), before, strict=True))
            if taken <= _MOST_STOLEN * passed:
                found.append((rates["one"], rates["nodes"], rates["nodes"] / rates["one"]))
    one, nodes, ratio = np.median(np.array(found or [(np.nan,) * 3]), axis=0)
    print(f"| {workload} | {one:.0f} | {nodes:.0f} | {ratio:.2f} | {len(found)} |", flush=True)


def _rate(env: Any, seconds: float) -> float:
    """Vector steps a second."""
    actions = env.action_space.sample()
    start, count = perf_counter(), 0
    while perf_counter() - start < seconds:
        env.step(actions)
        count += 1
    return count / (perf_counter() - start)


@contextlib.contextmanager
def _cluster(nodes: int) -> Iterator[None]:
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(nodes):
            cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        yield
    finally:
        ray.shutdown()
        cluster.shutdown()


if __name__ == "__main__":
    sys.exit(main())

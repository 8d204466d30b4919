"""``sandbox="docker"`` beside ``sandbox="process"`` and no sandbox: size, starts, steps.

    python -m benchmarks.containers                    # needs an engine and the image envhub-worker
    python -m benchmarks.containers --rounds 3 --seconds 0.2

Steps: the same environment three times in this process's hands; in every round each has one turn,
in a new order, and ratios stay within a round. Starts: each in a fresh interpreter, with a cache
that knows nothing (cold) and one that knows the manifest (warm). Prints one JSON document.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.driver import ROOT
from benchmarks.machine import machine
from envhub_sandbox import make_env
from envhub_sandbox.sandboxes.docker.engines import find_engine
from tests.support.samples import make_env_of

REPOSITORIES = ROOT / "benchmarks" / "repositories"
WORKLOADS = {"cartpole": (1, 4, 16, 64), "cameras": (4,)}
_START = """
import json, sys, time
begun = time.perf_counter()
from envhub_sandbox import make_env
imported = time.perf_counter()
suites = make_env(sys.argv[1], n_envs=4, sandbox=sys.argv[2])
made = time.perf_counter()
suites.env.reset(seed=0)
suites.env.step(suites.env.action_space.sample())
stepped = time.perf_counter()
suites.close()
closed = time.perf_counter()
times = dict(make_env_s=made - imported, first_step_s=stepped - imported, close_s=closed - stepped)
print(json.dumps(times))
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.containers")
    parser.add_argument("--image", default="envhub-worker")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=0.4, help="of one turn")
    parser.add_argument("--starts", type=int, default=5)
    options = parser.parse_args(arguments)
    docker = f"docker:{options.image}"
    results = {
        "machine": machine(),
        "image": image(options.image),
        "starts": {
            name: starts(place, options.starts) for name, place in _places(docker).items() if place
        },
        "steps": {
            f"{workload} n={count}": steps(workload, count, docker, options)
            for workload, counts in WORKLOADS.items()
            for count in counts
        },
    }
    print(json.dumps(results, indent=2))
    return 0


def _places(docker: str) -> dict[str, str]:
    return {"in process": "", "process": "process", "docker": docker}


def image(name: str) -> dict[str, Any]:
    """Bytes of the image, and of what lies on its base."""
    engine = find_engine(None)
    size = int(engine.run("image", "inspect", "--format", "{{.Size}}", name))
    words = ("history", "--no-trunc", "--human=false", "--format", "{{.Size}} {{.CreatedBy}}")
    layers = engine.run(*words, name)
    own = [int(line.split()[0]) for line in layers.splitlines() if "envhub-worker" in line]
    return {"engine": f"{engine.kind} {engine.version}", "bytes": size, "own_bytes": sum(own)}


def starts(place: str, times: int) -> dict[str, dict[str, float]]:
    """Medians in seconds, cold and warm."""
    cold, warm = [], []
    for _ in range(times):
        with tempfile.TemporaryDirectory(prefix="envhub-bench-") as cache:
            os.chmod(cache, 0o755)
            cold.append(_start(place, cache))
            warm.append(_start(place, cache))
    return {"cold": _medians(cold), "warm": _medians(warm)}


def _start(place: str, cache: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-c", _START, str(REPOSITORIES / "cartpole"), place],
        env=os.environ | {"ENVHUB_CACHE": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(json.loads(done.stdout))


def _medians(found: list[dict[str, float]]) -> dict[str, float]:
    return {name: round(statistics.median(one[name] for one in found), 4) for name in found[0]}


def steps(workload: str, count: int, docker: str, options: argparse.Namespace) -> dict[str, Any]:
    """Vector steps a second, and the container's as a ratio of the others' in the same round."""
    folder = REPOSITORIES / workload
    with contextlib.ExitStack() as stack:
        envs = {}
        for name, place in _places(docker).items():
            if not place:
                envs[name] = make_env_of(folder)(n_envs=count)
                stack.callback(envs[name].close)
            else:
                suites = make_env(str(folder), n_envs=count, sandbox=place)
                envs[name] = stack.enter_context(suites).env
        turns = {name: _turn(env) for name, env in envs.items()}
        for turn in turns.values():
            turn(options.seconds)
        rounds = [_round(turns, options.seconds) for _ in range(options.rounds)]
    return {
        "steps_per_s": {
            name: round(statistics.median(one[name] for one in rounds)) for name in turns
        },
        "docker_over_process": _ratios(rounds, "process"),
        "docker_over_in_process": _ratios(rounds, "in process"),
    }


def _turn(env: Any) -> Callable[[float], float]:
    env.action_space.seed(0)
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(16)]

    def turn(seconds: float) -> float:
        done, begun = 0, time.perf_counter()
        while (now := time.perf_counter()) - begun < seconds:
            for action in actions:
                env.step(action)
            done += len(actions)
        return done / (now - begun)

    return turn


def _round(turns: dict[str, Callable[[float], float]], seconds: float) -> dict[str, float]:
    order = random.sample(sorted(turns), len(turns))
    return {name: turns[name](seconds) for name in order}


def _ratios(rounds: list[dict[str, float]], other: str) -> dict[str, float]:
    found = [one["docker"] / one[other] for one in rounds]
    low, median, high = statistics.quantiles(found, n=4)
    return {"median": round(median, 3), "low": round(low, 3), "high": round(high, 3)}


if __name__ == "__main__":
    sys.exit(main())

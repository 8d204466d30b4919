"""How long things take to start, and what they hold: each in interpreters of their own."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from benchmarks.driver import ROOT
from benchmarks.load import Patience
from benchmarks.workloads import WORKLOADS
from tests.hub.stub_hub import StubHub

_TIMEOUT_S = 300.0
_CONTEXTS = ("fork", "forkserver", "spawn")
_SHARDS = 8
_WORKERS_PATIENCE_S = 20.0


class Probes:
    """Runs probes with a cache of their own.

    Args:
        folder: For the cache.
        patience: Waits for a quiet machine before each.
    """

    def __init__(self, folder: str, patience: Patience) -> None:
        self.folder = folder
        self.patience = patience

    def run(self, name: str, *arguments: object, **variables: str) -> dict[str, Any]:
        """One fresh interpreter's findings; ``{"failed": ...}`` where it failed."""
        self.patience.wait()
        result = subprocess.run(
            [sys.executable, "-m", "benchmarks.probe", name, *map(str, arguments)],
            cwd=ROOT,
            env=os.environ | {"PYTHONWARNINGS": "ignore", "ENVHUB_CACHE": self.folder} | variables,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
        if result.returncode:
            return {"failed": result.stderr.strip().splitlines()[-1][:300]}
        found: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
        return found

    def several(self, times: int, name: str, *arguments: object, **variables: str) -> Any:
        """Medians over several interpreters."""
        found = [self.run(name, *arguments, **variables) for _ in range(times)]
        failed = [one for one in found if "failed" in one]
        if failed:
            return failed[0]
        return {key: round(statistics.median(one[key] for one in found), 2) for key in found[0]}


def measure_spawning(times: int, patience: Patience) -> dict[str, Any]:
    """Everything about starting; ``times`` is the number of workers, and a bound on the rest."""
    local = str(WORKLOADS["cartpole"].folder)
    few = max(1, min(times // 5, 7))
    with tempfile.TemporaryDirectory() as folder, _pinned() as (pin, endpoint):
        probes = Probes(folder, patience)
        hub = {"HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0"}
        return {
            "imports": probes.several(few, "imports"),
            "first_step_cold": _cold(few, patience, pin, hub),
            "fetched": probes.run("first_step", pin, **hub),
            "first_step_warm": probes.several(few, "first_step", pin, **hub),
            "make_env": _calls(probes.run("make_again", pin, times, **hub)),
            "make_env_local": _calls(probes.run("make_again", local, times)),
            "workers": _workers(probes.run("workers", pin, times, _WORKERS_PATIENCE_S, **hub)),
            "async_vector_env": {
                context: probes.several(few, "async_vector_env", context, _SHARDS)
                for context in _CONTEXTS
            },
            "memory": _memory(probes, local),
        }


@contextmanager
def _pinned() -> Iterator[tuple[str, str]]:
    """CartPole at a commit of a Hub on loopback: a reference, and the endpoint."""
    source = (WORKLOADS["cartpole"].folder / "env.py").read_text()
    with StubHub() as hub:
        commit = hub.add("benchmarks/cartpole", {"env.py": source}).commit
        yield f"benchmarks/cartpole@{commit}", hub.endpoint


def _cold(times: int, patience: Patience, pin: str, hub: dict[str, str]) -> Any:
    """First steps without a snapshot and without a manifest."""
    found = []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as folder:
            found.append(Probes(folder, patience).run("first_step", pin, HF_HOME=folder, **hub))
    failed = [one for one in found if "failed" in one]
    if failed:
        return failed[0]
    return {key: round(statistics.median(one[key] for one in found), 2) for key in found[0]}


def _calls(found: dict[str, Any]) -> dict[str, Any]:
    return found if "failed" in found else {"first": found["first"], **spread(found["later"])}


def _workers(found: dict[str, Any]) -> dict[str, Any]:
    if "failed" in found:
        return found
    return {**found, "spawn": spread(found["spawn"]), "ready": spread(found["ready"])}


def _memory(probes: Probes, reference: str) -> dict[str, Any]:
    if os.geteuid() != 0:
        return {"not measured": "only root may read what the processes of a jail take"}
    one = probes.run("memory", reference, _SHARDS, 1)
    several = probes.run("memory", reference, _SHARDS, _SHARDS)
    own = probes.run("own_memory", "cartpole")
    result: dict[str, Any] = {"one worker": one, f"{_SHARDS} workers": several}
    if not any("failed" in found for found in (one, several, own)):
        further = (several["total"] - one["total"]) / (_SHARDS - 1)
        result["each further worker"] = round(further, 2)
        result["of it the environment's own"] = own["total"]
    return result


def spread(costs: Sequence[float]) -> dict[str, Any]:
    """Median and 95th percentile, in milliseconds."""
    ordered = sorted(costs)
    return {
        "p50": round(statistics.median(ordered), 3),
        "p95": round(ordered[min(len(ordered) - 1, len(ordered) * 95 // 100)], 3),
        "times": len(ordered),
    }

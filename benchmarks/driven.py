"""One peer in a process of its own: ``python -m benchmarks.driven PEER WORKLOAD COUNT``.

Reads orders from stdin and writes reports to stdout, one JSON object a line. The first report
says ``{"ready": true, "setting": ...}`` or ``{"missing": ...}`` or ``{"failed": ...}``. An order
is ``{"do": "slice", ...}`` with ``Slice``'s fields or ``{"do": "close"}``. It ends with its stdin.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import platform
import sys
import traceback
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any, TextIO

from benchmarks.clock import Slice, run_slice
from benchmarks.peers import PEERS, Opened, Peer, Setting
from benchmarks.peers.missing import Missing
from benchmarks.workloads import WORKLOADS, Workload, action_batches

_CHOOSING = Slice(seconds=0.15, least_steps=3)
_DIGEST_STEPS = 40


def main() -> None:
    """Open the peer, then obey."""
    reports = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # peers print
    peer, workload, count = PEERS[sys.argv[1]], WORKLOADS[sys.argv[2]], int(sys.argv[3])
    try:
        opened, ready = _open(peer, workload, count)
    except Missing as missing:
        _tell(reports, missing=str(missing))
        return
    except Exception as error:
        traceback.print_exc()
        _tell(reports, failed=f"{type(error).__name__}: {error}"[:500])
        return
    _tell(reports, **ready)
    actions = itertools.cycle(action_batches(workload.name, count))
    for line in sys.stdin:
        order = json.loads(line)
        if order["do"] == "close":
            break
        _tell(reports, **_obey(opened, order, actions))
    opened.close()


def _tell(reports: TextIO, **report: Any) -> None:
    reports.write(json.dumps(report) + "\n")


def _open(peer: Peer, workload: Workload, count: int) -> tuple[Opened, dict[str, Any]]:
    setting = _best_setting(peer, workload, count)
    opened = peer.open(workload, count, setting)
    digest = _digest(opened, workload, count) if peer.digested else None
    ready = {
        "ready": True,
        "setting": setting,
        "digest": digest,
        "python": platform.python_version(),
        "versions": _versions(peer),
    }
    return opened, ready


def _best_setting(peer: Peer, workload: Workload, count: int) -> Setting:
    settings = peer.settings(count)
    if len(settings) == 1:
        return settings[0]
    costs = []
    for setting in settings:
        opened = peer.open(workload, count, setting)
        actions = itertools.cycle(action_batches(workload.name, count))
        costs.append(run_slice(opened, _CHOOSING, actions)["mean_ns"])
        opened.close()
    return settings[costs.index(min(costs))]


def _digest(opened: Opened, workload: Workload, count: int) -> str:
    """Of the first steps' observations, rewards and flags: peers must have done the same work."""
    digest = hashlib.sha256()
    batches = itertools.cycle(action_batches(workload.name, count))
    for actions in itertools.islice(batches, _DIGEST_STEPS):
        observation, *others, _ = opened.step(actions)
        leaves = observation.values() if isinstance(observation, dict) else [observation]
        for array in [*leaves, *others]:
            digest.update(array.tobytes())
    return digest.hexdigest()[:16]


def _versions(peer: Peer) -> dict[str, str]:
    found = {}
    for name in ("gymnasium", "numpy", "mujoco", "stable-baselines3", "pufferlib"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    for module, name in (("openenv", "openenv-core"), ("envpool", "envpool")):
        if module in peer.needs:
            found[name] = version(name)
    return found


def _obey(opened: Opened, order: dict[str, Any], actions: Iterator[Any]) -> dict[str, Any]:
    what = order.pop("do")
    if what == "slice":
        return run_slice(opened, Slice(**order), actions)
    raise ValueError(f"unknown order {what!r}")


if __name__ == "__main__":
    main()

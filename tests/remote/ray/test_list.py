"""``envhub check --all --sandbox ray``: a list is judged over a cluster."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.remote.ray.clusters import servers
from tests.support.command_line import envhub
from tests.support.processes import eventually
from tests.support.repositories import write_repository
from tests.support.samples import sample

ray = pytest.importorskip("ray")


def test_a_list_is_judged_over_a_cluster(cluster: Any, tmp_path: Path) -> None:
    """Each with one server, as many at once as fit; the verdicts are those of this machine."""
    broken = write_repository(tmp_path / "broken", "raise RuntimeError('no')\n")
    listed = tmp_path / "list.txt"
    listed.write_text(f"{sample('cartpole')}\n{broken}\n")
    quick = ("--steps", "20", "--resets", "0", "--output", tmp_path / "out")
    words = ("check", "--all", listed, "--sandbox", "ray", *quick)
    done = envhub(*words, RAY_ADDRESS=cluster.address)
    assert done.returncode == 1, done.stderr
    found = json.loads((tmp_path / "out" / "index.json").read_text())
    verdicts = {one["reference"]: one["verdict"] for one in found["results"]}
    assert verdicts == {str(sample("cartpole")): "passed", str(broken): "failed"}
    assert eventually(lambda: not servers())

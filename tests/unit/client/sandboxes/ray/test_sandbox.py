"""What ``RaySandbox`` takes and refuses, and what it believes of what a node says."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import RaySandbox
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.factory.arguments import sandbox_of
from envhub_sandbox.sandboxes.ray import cluster, sandbox
from envhub_sandbox.settings.policy import Policy
from envhub_worker.protocol.runtime import OWN, Runtime

GOOD = {"endpoint": "tcp://10.0.0.3:4711", "key": "ab" * 32, "node": "0f" * 28, "gpus": [1, 0]}


@pytest.fixture
def with_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "check_installed", lambda: None)


@pytest.mark.parametrize(
    "lie",
    [
        *({"endpoint": one} for one in ("", "tcp://10.0.0.3", "ipc:///tmp/x", "tcp://a.b:1", 7)),
        *({"endpoint": f"tcp://{one}"} for one in ("10.0.0.3:1/x", "u:p@10.0.0.3:1", "*:1")),
        *({"endpoint": f"tcp://10.0.0.3:{one}"} for one in ("99999", "1;tcp://1.1.1.1:1")),
        *({"endpoint": f"tcp://[fe80::1%{one}]:1"} for one in ("\x1b[2J", "\u202e", "a\nb")),
        *({"key": one} for one in ("", "ab" * 31, None, ["ab" * 32])),
        *({"node": one} for one in ("", "x" * 65, "\x1b[2J", 3, "\u0663")),
        *({"gpus": one} for one in ([-1], ["0"], [True], None, 1, "", {}, [10**400])),
    ],
)
def test_a_lie_of_a_node_is_refused(lie: dict[str, Any]) -> None:
    """Before anything is connected to; each part is needed, and an address of IPv6 is one."""
    assert sandbox.read_started(GOOD) == (GOOD["endpoint"], b"\xab" * 32, GOOD["node"], (1, 0))
    on_six = GOOD | {"endpoint": "tcp://[fd00::3]:4711"}
    assert sandbox.read_started(on_six)[0] == "tcp://[fd00::3]:4711"
    with pytest.raises(WorkerStartupError, match="no server"):
        sandbox.read_started(GOOD | lie)
    with pytest.raises(WorkerStartupError):
        sandbox.read_started({name: GOOD[name] for name in GOOD if name not in lie})


@pytest.mark.parametrize(
    "options",
    [{"num_cpus": -1}, {"num_gpus": float("nan")}, {"resources": {"x": -1}}, {"placement_s": 0}],
)
def test_impossible_numbers_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match="RaySandbox"):
        RaySandbox(**options)


@pytest.mark.usefixtures("with_ray")
@pytest.mark.parametrize(
    ("policy", "runtime", "says"),
    [
        (Policy(gpu=True), OWN, "num_gpus"),
        (Policy(gpu=(0,)), OWN, "Ray chooses the node"),
        (Policy(readable=("/data",)), OWN, "paths of this machine"),
        (Policy(), Runtime("/usr/bin/python3"), "interpreter of this machine"),
    ],
)
def test_what_a_node_cannot_give_is_refused(policy: Policy, runtime: Runtime, says: str) -> None:
    place = RaySandbox(num_gpus=0 if says == "num_gpus" else 1)
    with pytest.raises(PolicyError, match=says):
        place.for_repository(Path("/nowhere"), policy, runtime)


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SandboxUnavailableError, match=r"envhub-sandbox\[ray\]"):
        RaySandbox().for_repository(Path("/nowhere"), Policy(), OWN)


def test_copies_have_the_options_and_none_of_the_servers() -> None:
    """Each is a place of its own, as env runners of RLlib get it; the name means one place."""
    place = RaySandbox(num_cpus=2, resources={"x": 1}, shared=True)
    for other in (copy.copy(place), copy.deepcopy(place), pickle.loads(pickle.dumps(place))):
        assert other is not place
        assert other != place
        assert other.placement() == {"num_cpus": 2, "num_gpus": 0.0, "resources": {"x": 1}}
        assert other.shared
    assert sandbox_of("ray", None) is sandbox_of("ray", None) is sandbox.RAY

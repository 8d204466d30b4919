"""Every way in which LeRobot's pages use the Hub works with its own ``make_env``, installed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.hub.olah_server import OlahServer
from tests.lerobot.kit import run
from tests.lerobot.repositories import publish

pytest.importorskip("torch")

ONE = {"hub_env": [0]}
EXPECTED = {
    # the control: without install() LeRobot refuses, and runs the code in its own process
    "control refused": ["RuntimeError"],
    "control executed here": True,
    # references and results
    **dict.fromkeys(("branch", "tag", "commit", "file", "space", "single"), ONE),
    "suites": {"near": [0, 1], "far": [0]},
    "no consent": ONE,
    "async": ONE,
    "played": True,
    "one": [True, False, 3],
    "configured": ["open the door", "open the door"],
    "pendulum": {"observation.state": [2, 3]},
    # our own type
    "pinned": True,
    "chosen": [["push", "push"]],
    "chosen shape": {"near": [1]},
    # how many, and async, LeRobot says itself; a token is nothing for what it prints and saves
    "not options": ["cfg", "n_envs", "token", "trust_remote_code", "use_async_envs"],
    "waits": [True, True, False],
    "plugin": "SandboxedEnvConfig",
    # failures: the builtin errors that LeRobot would have raised
    "nothing": ["AttributeError"],
    "missing": ["ImportError"],
    "wrong": ["ValueError"],
    "no repository": ["OSError"],
    "option": True,
    "login": True,
    "executed here": False,
}
FEATURES = {
    "action": ["ACTION", 6],
    "observation.state": ["STATE", 6],
    "observation.images.top": ["VISUAL", 3, 24, 32],
    "observation.images.wrist": ["VISUAL", 3, 24, 32],
}


def test_the_pages_hold(olah: OlahServer, tmp_path: Path) -> None:
    """With LeRobot's own functions, in one process, which has loaded nothing of the Hub after."""
    found = run("pages_program.py", olah, tmp_path, json.dumps(publish(olah)))
    features = found.pop("features")
    features.pop("observation.forces", None)  # LeRobot 0.6 hands it on, 0.4 does not
    assert features == FEATURES
    assert "jail" not in found.pop("stderr")
    assert found == EXPECTED

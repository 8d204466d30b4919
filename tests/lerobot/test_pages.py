"""Every way in which LeRobot's pages use the Hub works with its own ``make_env``, installed."""

import json
from pathlib import Path

import pytest

from tests.hub.olah_server import OlahServer
from tests.lerobot.kit import run, written
from tests.lerobot.repositories import COUNTING, publish

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
    # what is given of features goes before what the spaces say
    "renamed": ["action", "observation.environment_state", "observation.state.arm"],
    "further": [
        *("action", "observation.environment_state", "observation.state", "observation.touch")
    ],
    "unnamed": True,
    "misspelt feature": True,
    # its rollouts, beside its own FreezeAfterEpisodeEnd
    "freezes": True,
    "plugin": "SandboxedEnvConfig",
    # failures: the builtin errors that LeRobot would have raised
    "nothing": ["AttributeError"],
    "missing": ["ImportError"],
    "wrong": ["ValueError"],
    "no repository": ["OSError"],
    "option": True,
    "login": True,
    "cures": [True, True, True],
    "executed here": False,
}
PROCESSED = {
    "libero": ["observation.images.image", "observation.images.image2", "observation.state"],
    "declared": ["observation.images.image", "observation.images.wrist", "observation.state"],
    "arena": ["observation.images.robot_pov_cam_rgb", "observation.state"],
}
FEATURES = {
    "action": ["ACTION", 6],
    "observation.state": ["STATE", 6],
    "observation.images.top": ["VISUAL", 3, 24, 32],
    "observation.images.wrist": ["VISUAL", 3, 24, 32],
}
POLICY = '{"type": "act"}'


@pytest.mark.timeout(900)  # it imports LeRobot, which a loaded machine does slowly
def test_the_pages_hold(olah: OlahServer, tmp_path: Path) -> None:
    """With LeRobot's own functions, in one process, which has loaded nothing of the Hub after."""
    olah.repository("robots/policy").commit({"config.json": POLICY})
    commits, (commands, python) = publish(olah), written("robots/reach")
    arguments = json.dumps(commits), json.dumps(commands), python, COUNTING
    found = run("pages_program.py", olah, tmp_path, *arguments)
    features = found.pop("features")
    features.pop("observation.forces", None)  # LeRobot 0.6 hands it on, 0.4 does not
    assert features == FEATURES
    stub = "a stub replaces it"  # where the jails have no LeRobot
    said = [line for line in found.pop("stderr").splitlines() if stub not in line]
    assert "jail" not in "\n".join(said)
    if "commands" in found:  # LeRobot 0.4 has other options, and asks no configuration
        pinned = f"models/robots/reach@{commits['reach']}"
        ours = ["SandboxedEnvConfig", pinned, "act"]
        sandboxed = ["IsaaclabArenaEnv", None, "act"]
        assert found.pop("commands") == [ours, ours, sandboxed, ours]
        assert found.pop("said once") == [True, True, True]
        for name, names in PROCESSED.items():
            told = [] if name == "arena" else [True]
            assert found.pop(name) == [True, True, names, told]
        assert found.pop("misdeclared")
        assert (found.pop("misspelt"), found.pop("written")) == ("refused", ONE)
    assert found == EXPECTED

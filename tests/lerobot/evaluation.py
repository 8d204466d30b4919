"""LeRobot's evaluation is the same in the sandbox: run by ``python -m tests.lerobot`` only."""

import json
from pathlib import Path

from tests.hub.olah_server import OlahServer
from tests.lerobot.kit import run, written
from tests.lerobot.repositories import ARENA, REACH


def test_an_evaluation_is_the_same(olah: OlahServer, tmp_path: Path) -> None:
    """Returns, successes and the bytes of videos, by each way into the sandbox; by the commands of
    the pages, with the sizes of a test added."""
    commit = olah.repository("robots/evaluated").commit({"env.py": REACH})
    olah.repository("nvidia/isaaclab-arena-envs").commit({"env.py": ARENA})
    commands = json.dumps(written("robots/evaluated")[0])
    found = run("evaluation_program.py", olah, tmp_path, f"robots/evaluated@{commit}", commands)
    here = found["here"]
    assert found["executed by LeRobot"]  # the control: that code was in that process
    assert (len(here["metrics"]), len(here["videos"])) == (1, 4)
    assert found["installed"] == here
    assert found["own"] == here
    if found["asks configs"]:
        assert found["pages"] == [here, here]
        assert len(found["arena"]["videos"]) == 4
        assert found["arena of the page"] == found["arena"]
        assert found["jails of plugin"] == 1  # the one that told the spaces
    assert "Refusing to execute" in found["train before"]
    assert found["train after"] == "made"
    assert not found["executed here"]

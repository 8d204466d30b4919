"""LeRobot's training, evaluated in the sandbox, is the same: by ``python -m tests.lerobot``."""

from pathlib import Path

import pytest

from tests.hub.olah_server import OlahServer
from tests.lerobot.kit import run, written
from tests.lerobot.repositories import REACH


def test_a_training_is_the_same(olah: OlahServer, tmp_path: Path) -> None:
    """To its end: what it evaluates to, the bytes of videos, and the weights of checkpoints; by the
    command of the page, with the sizes of a test added."""
    commit = olah.repository("robots/trained").commit({"env.py": REACH})
    [command] = [
        words for program, *words in written("robots/trained")[0] if program == "lerobot-train"
    ]
    file = tmp_path / "env.py"
    file.write_text(REACH)
    found = run("training_program.py", olah, tmp_path, str(file), *command)
    if not found["asks configs"]:
        pytest.skip("this LeRobot lets no configuration make its environments")
    here = found["here"]
    assert found["executed by LeRobot"]  # the control: that code was in that process
    assert (len(here["evaluations"]), len(here["weights"]), len(here["videos"])) == (2, 2, 8)
    assert found["sandboxed"] == here
    assert found["saved"].endswith(f"robots/trained@{commit}")  # the branch, pinned
    # resumed from the last checkpoint, by what was saved
    assert (len(found["resumed"]["evaluations"]), len(found["resumed"]["weights"])) == (1, 3)
    assert not found["executed here"]

"""The examples for other libraries run as their first lines say; RLlib's and LeRobot's by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.command_line import python
from tests.support.samples import EXAMPLES

pytestmark = pytest.mark.same_for("users")


@pytest.mark.parametrize(
    ("script", "needs", "printed"),
    [
        ("with_cleanrl.py", "torch", "the weights are the same, to the last bit: True"),
        ("with_cleanrl_async.py", "torch", "episodes: the first last"),
        ("with_sb3.py", "stable_baselines3", "trained for 512 steps"),
        ("with_torchrl.py", "torchrl", "a rollout of 40 steps"),
    ],
)
def test_example_script(script: str, needs: str, printed: str, tmp_path: Path) -> None:
    """Each ends well and prints what it promises."""
    pytest.importorskip("torch")
    pytest.importorskip(needs)
    done = python(EXAMPLES / script, ENVHUB_CACHE=str(tmp_path / "cache"))
    assert printed in done.stdout

"""The examples for other libraries run as their first lines say; RLlib's and LeRobot's by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.command_line import python
from tests.support.samples import EXAMPLES

pytestmark = pytest.mark.same_for("users")

PRINTED = {
    "with_cleanrl.py": "the weights are the same, to the last bit: True",
    "with_cleanrl_async.py": "episodes: the first last",
    "with_sb3.py": "trained for 512 steps",
}
"""What each prints; that of TorchRL is in ``test_torchrl.py``."""
# one after the other, since importing torch takes longer than to run them
_RUN = "import runpy, sys\nfor path in sys.argv[1:]: runpy.run_path(path, run_name='__main__')"


def test_example_scripts(tmp_path: Path) -> None:
    """Each ends well and prints what it promises."""
    for needed in ("torch", "stable_baselines3"):
        pytest.importorskip(needed)
    scripts = [EXAMPLES / name for name in PRINTED]
    done = python("-c", _RUN, *scripts, ENVHUB_CACHE=str(tmp_path / "cache"))
    assert all(printed in done.stdout for printed in PRINTED.values()), done.stdout

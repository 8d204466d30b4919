"""The blocks of ``docs/ray.md`` do what they say, on a cluster."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.command_line import COMMAND
from tests.support.documents import blocks

ray = pytest.importorskip("ray")
EXAMPLE = str(blocks.CHECKOUT / "examples" / "cartpole")


def test_the_blocks_run(cluster: Any, tmp_path: Path) -> None:
    here = Path(__file__).relative_to(blocks.CHECKOUT).as_posix()
    ours = [one for one in blocks.tested(blocks.OWN) if one.apart == here]
    assert [one.language for one in ours] == ["python", "sh"]
    variables = {**os.environ, "RAY_ADDRESS": cluster.address}
    for block in ours:
        text = block.text.replace("org/repo@<commit>", EXAMPLE)
        text = re.sub(r"(num.workers.)16", r"\g<1>4", text)  # as this cluster has CPUs
        command = [sys.executable, "-c", text]
        if block.language == "sh":
            words = text.split()
            assert words.pop(0) == "envhub"
            command = [*COMMAND, *words, "--steps", "20"]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=240, env=variables, cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr

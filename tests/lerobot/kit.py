"""Runs a program in an interpreter that has LeRobot, and reads what it found."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import envhub_sandbox
import envhub_worker
from tests.hub.olah_server import OlahServer
from tests.support.documents import blocks

OVERLAY = "ENVHUB_TEST_LEROBOT"
"""A folder with LeRobot and what it imports at least, for this interpreter: ``./test`` makes it."""
OWN = "ENVHUB_TEST_LEROBOT_PYTHON"
"""An interpreter that has all of LeRobot: ``python -m tests.lerobot`` makes it."""
THEIRS = "ENVHUB_TEST_LEROBOT_SOURCE"
"""A folder with LeRobot's repository at that version, if there is one."""
READ_AS = {
    "org/policy": "robots/policy",
    "org/dataset": "robots/recorded",
    "=...": "=robots/policy",
    '{"gpu": true}': "{}",
    '{"gpu": True}': "{}",
}
"""What our own pages write, and what stands there instead: nobody here has a GPU."""


def written(repository: str) -> tuple[list[list[str]], str]:
    """The commands of LeRobot's, and the Python, that ``blocks.APART`` leaves to this folder."""
    here = Path(__file__).with_name("test_pages.py").relative_to(blocks.CHECKOUT).as_posix()
    ours = [one for one in blocks.tested(blocks.OWN) if one.apart == here]
    texts = {"sh": "", "python": ""}
    for one in ours:
        texts[one.language] += one.text.replace("\\\n", " ")
    for old, new in {"org/repo@<commit>": f"{repository}@main", **READ_AS}.items():
        texts = {language: text.replace(old, new) for language, text in texts.items()}
    return [shlex.split(line) for line in texts["sh"].splitlines()], texts["python"]


def run(program: str, olah: OlahServer, home: Path, *arguments: str) -> Any:
    """The last line that a program of this folder prints, which is JSON.
    The test is skipped where there is no LeRobot."""
    own, overlay = os.environ.get(OWN), os.environ.get(OVERLAY)
    if not own and not overlay:
        pytest.skip("needs LeRobot")
    checkout = Path(__file__).parents[2]
    plugin = checkout / "plugins" / "lerobot_env_envhub_sandbox"
    ours = [Path(module.__file__).parents[1] for module in (envhub_sandbox, envhub_worker)]
    paths = [plugin, *ours, checkout] if own else [Path(str(overlay)), plugin]
    environment = {
        **{one: text for one, text in os.environ.items() if not one.startswith(("HF_", "HUGGING"))},
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "ENVHUB_CACHE": str(home / "store"),
        "HF_HOME": str(home / "hf"),
        "HF_ENDPOINT": olah.endpoint,
        "HF_HUB_DISABLE_XET": "1",
        "SLURM_JOB_ID": "0",  # it draws no progress bars there
    }
    done = subprocess.run(
        [own or sys.executable, str(Path(__file__).with_name(program)), *arguments],
        env=environment,
        cwd=home,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-6000:] + done.stdout[-2000:]
    return {**json.loads(done.stdout.splitlines()[-1]), "stderr": done.stderr}

"""``envhub check --all``: a list is judged, and goes on where it was interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.support.command_line import COMMAND, below, envhub, gone
from tests.support.pages import Page
from tests.support.processes import eventually
from tests.support.repositories import write_repository

_QUICK = ("--steps", "4", "--resets", "0", "--n-envs", "1", "--memory", "1G")
_HONEST = """
import gymnasium as gym
import numpy as np

class Count(gym.Env):
    observation_space = gym.spaces.Box(0, 100, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    count = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.array([self.count], np.float32), 1.0, self.count >= 10, False, {}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Count] * n_envs)
"""
_BROKEN = _HONEST.replace("self.count += 1", "raise RuntimeError('it broke')")
_STUCK = "import time\ntime.sleep(3600)\n"


def index(folder: Path) -> list[dict[str, Any]]:
    """What stands in the index: what fails, what could not be judged, what passed."""
    read: list[dict[str, Any]] = json.loads((folder / "index.json").read_text())["results"]
    return read


def verdicts(folder: Path) -> dict[str, str]:
    """Of each repository, by its folder's name."""
    return {Path(one["reference"]).name: one["verdict"] for one in index(folder)}


def listed(folder: Path, *names: str) -> Path:
    """A list of folders beside it."""
    path = folder / "list"
    path.write_text("# ours\n" + "\n".join(f"{folder}/{name}" for name in names) + "\n")
    return path


def test_a_list_is_judged_and_then_what_has_changed(tmp_path: Path) -> None:
    """Each by itself; the second time what is another, and what has no verdict yet."""
    write_repository(tmp_path / "honest", _HONEST, README__md="# Walk", LICENSE="MIT")
    broken = write_repository(tmp_path / "broken", _BROKEN, README__md="# Walk", LICENSE="MIT")
    (tmp_path / "empty").mkdir()
    out, junit = tmp_path / "out", tmp_path / "junit.xml"
    options = ("--all", listed(tmp_path, "honest", "broken", "empty"), "--output", out, *_QUICK)
    first = envhub("check", *options, "--jobs", "2", "--junit", junit)
    assert first.returncode == 1, first.stderr
    assert verdicts(out) == {"honest": "passed", "broken": "failed", "empty": "not judged"}
    failed, empty, honest = index(out)
    assert failed["fails"] == ["runs"]
    [why] = failed["why"]
    assert why.startswith("runs: RuntimeError: it broke (File ")
    assert "broken/env.py" in why
    assert "in step)" in why
    assert "no file 'env.py'" in empty["said"]
    suites = ElementTree.parse(junit).getroot()
    assert [suite.attrib["failures"] for suite in suites] == ["1", "0", "0"]
    assert [suite.attrib["errors"] for suite in suites] == ["0", "1", "0"]
    page = Page((out / "index.html").read_text())
    links = [dict(attributes)["href"] for tag, attributes in page.tags if tag == "a"]
    assert sorted(map(str, links)) == sorted([honest["page"], failed["page"]])
    assert "it broke" in (out / str(failed["page"])).read_text()
    assert json.loads((out / str(failed["report"])).read_text())["passed"] is False

    write_repository(broken, _BROKEN.replace("it broke", "it broke again"))
    second = envhub("check", *options)
    assert second.returncode == 1, second.stderr
    assert verdicts(out) == {"honest": "passed", "broken": "failed", "empty": "not judged"}
    assert index(out)[2] == honest, "it was not judged again"
    assert second.stderr.count("as it was judged before") == 1
    assert index(out)[0]["commit"] != failed["commit"]
    assert "it broke again" in (out / str(failed["page"])).read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_what_is_finished_stays_and_nothing_else(tmp_path: Path, number: signal.Signals) -> None:
    """However a run is ended: no process of it is left, and the index is whole."""
    write_repository(tmp_path / "stuck", _STUCK)
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    options = ["--all", str(listed(tmp_path, "empty", "stuck")), "--output", str(out), *_QUICK]
    with (
        tempfile.TemporaryDirectory(prefix="e", dir="/tmp", ignore_cleanup_errors=True) as folder,
        subprocess.Popen(
            [*COMMAND, "check", *options, "--jobs", "2"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": folder},
        ) as process,
    ):
        # the judgement, its worker server, its zygote, and a jail below it
        assert eventually(lambda: len(below(process.pid)) >= 4, 120)
        assert eventually(
            lambda: (out / "index.json").exists() and verdicts(out)["empty"] == "not judged", 120
        )
        processes = below(process.pid)
        process.send_signal(number)
        _, said = process.communicate(timeout=120)
        assert eventually(lambda: gone(processes), 120)
        if number is signal.SIGINT:
            assert (process.returncode, said.splitlines()[-1]) == (130, "Interrupted.")
            assert sorted(os.listdir(out)) == [
                ".envhub-check",
                "index.html",
                "index.json",
                "reports",
            ]
    assert verdicts(out) == {"empty": "not judged", "stuck": "waiting"}

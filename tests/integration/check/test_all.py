"""``envhub check --all``: a list is judged, and goes on where it was interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.corpus.entries import Entry
from tests.support.command_line import COMMAND, below, envhub, gone
from tests.support.output.pages import Page
from tests.support.processes import eventually
from tests.support.repositories import write_repository

pytestmark = pytest.mark.same_for("users")

_QUICK = ("--steps", "4", "--resets", "0", "--n-envs", "1", "--memory", "1G")
_HONEST = Entry(group="honest")
_BREAKS = "def step(self, action):\n    raise RuntimeError('it broke')"
_BROKEN = Entry(group="broken", env=_BREAKS)
_STUCK = "import time\ntime.sleep(3600)\n"


def index(folder: Path) -> list[dict[str, Any]]:
    """What stands in the index: what fails, what could not be judged, what passed."""
    read: list[dict[str, Any]] = json.loads((folder / "index.json").read_text())["results"]
    return read


def verdicts(folder: Path) -> dict[str, str]:
    """Of each repository, by its folder's name."""
    return {Path(one["reference"]).name: one["verdict"] for one in index(folder)}


def listed(folder: Path, *names: str) -> Path:
    path = folder / "list"
    path.write_text("# ours\n" + "\n".join(f"{folder}/{name}" for name in names) + "\n")
    return path


def test_a_list_is_judged_and_then_what_has_changed(tmp_path: Path) -> None:
    """Each by itself; the second time what is another, and what has no verdict yet."""
    _HONEST.write(tmp_path / "honest")
    broken = _BROKEN.write(tmp_path / "broken")
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

    replace(_BROKEN, env=_BREAKS.replace("it broke", "it broke again")).write(broken)
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

"""A repository that answers for our runner, before the judge of ``envhub check``. What it plays can
be made up; its files, what is counted outside of the jail, and the client's bounds cannot."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.corpus.entries import Entry
from tests.support.command_line import envhub

_HEAD = "import ctypes, os, random, sys, time\n"
_FAULTS = """
def reset(self, *, seed=None, options=None):
    os.fork() or time.sleep(3600)
    ctypes.CDLL(None).socket(2, 1, 0)
    self.at, self.count = random.random(), 0
    return self.observation(), {}

def move(self, action):
    self.at = random.random()
"""
_FORGER = """
runner = sys.modules["envhub_worker.runner.runner"]
tasks = sys.modules["envhub_worker.runner.tasks"]
describe = runner.manifest.describe

class Shown(Walk):
    def reset(self, **options):
        Env.reset(self)
        return super().reset(**options)

class Outside(Shown):
    def observation(self):
        return np.full(2, 1000.0, np.float32)

"""
_SHOW = _FORGER + "tasks.Task.build_one = lambda self, index: {}()"
_FILES, _COUNTED = {"source-compiled"}, {"denied-network", "leaks-processes"}
_SEEN = {
    "by an honest runner": ("", {"seeding", *_COUNTED}),
    "of another environment": (_SHOW.format("Shown"), _COUNTED),
    "outside of its own space": (
        _SHOW.format("Outside"),
        {"observation-space", "denied-network"},
    ),
    "of no environment": (
        _FORGER + "runner.manifest.describe = lambda tasks: describe([])",
        {"loads"},
    ),
    "that ends it": (
        _SHOW.format("Env") + "\nEnv.step = lambda *_: os._exit(0)",
        {"survives", "denied-network"},
    ),
}


@pytest.mark.parametrize("answers", _SEEN)
def test_what_is_seen_from_outside_cannot_be_forged(answers: str, tmp_path: Path) -> None:
    """Nor that it fails; the honest runner is the control."""
    code, seen = _SEEN[answers]
    files = {"other.pyc": b"compiled"}
    entry = Entry(group="forged", head=_HEAD, env=_FAULTS, code=code, files=files)
    options = ("--json", "--steps", "4", "--resets", "1")
    checked = envhub("check", entry.write(tmp_path / "walk"), *options, code=1)
    report: dict[str, Any] = json.loads(checked.stdout)
    findings = report["findings"]
    assert {row["check"] for row in findings if row["severity"] != "note"} == seen | _FILES
    assert report["confinement"]["missing"] == []

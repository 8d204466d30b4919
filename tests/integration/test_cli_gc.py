"""``envhub gc``, as a user runs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox.sandboxes.owner import identity_of


def gc(temporary: Path, *options: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run it with a folder for temporary files of its own, and without an engine."""
    variables = {"TMPDIR": str(temporary), "PATH": str(temporary)}
    return subprocess.run(
        [sys.executable, "-I", "-m", "envhub_sandbox", "gc", *options],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=check,
    )


def left_behind(temporary: Path) -> Path:
    """The folder of a container whose client has ended."""
    child = subprocess.Popen([sys.executable, "-S", "-c", "input()"], stdin=subprocess.PIPE)
    folder = temporary / "envhub-docker-abcd0123"
    folder.mkdir(mode=0o700)
    (folder / "client").write_text(identity_of(child.pid))
    child.communicate()
    return folder


def test_a_dry_run_removes_nothing(tmp_path: Path) -> None:
    """It names what it found."""
    folder = left_behind(tmp_path)
    assert f"found: folder {folder}" in gc(tmp_path, "--dry-run").stdout
    assert folder.exists()


def test_what_was_left_behind_is_removed(tmp_path: Path) -> None:
    """And said to be; the next run finds nothing."""
    folder = left_behind(tmp_path)
    said = json.loads(gc(tmp_path, "--json").stdout)
    assert {"kind": "folder", "name": str(folder), "removed": True} in said["found"]
    assert not folder.exists()
    again = json.loads(gc(tmp_path, "--json").stdout)
    assert [one for one in again["found"] if one["kind"] == "folder"] == []


@pytest.mark.parametrize(
    "docker", ["exit 1", 'echo "{\\"ServerVersion\\": \\"28\\"}"; [ $1 != ps ]']
)
def test_an_engine_that_is_down_is_said_to_be_so(tmp_path: Path, docker: str) -> None:
    """Nobody knows its containers; what else was left behind is removed all the same."""
    folder, program = left_behind(tmp_path), tmp_path / "docker"
    program.write_text(f"#!/bin/sh\n{docker}\n")
    program.chmod(0o755)
    done = gc(tmp_path, check=False)
    assert done.returncode == 9
    assert "docker could not be asked, so its containers are not known" in done.stderr
    assert not folder.exists()
    again = gc(tmp_path, "--json", check=False)
    assert again.returncode == 9
    assert set(json.loads(again.stdout)["unasked"]) == {"docker"}

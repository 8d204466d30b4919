"""``envhub gc``, as a user runs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from envhub_sandbox.sandboxes.owner import identity_of


def gc(temporary: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run it with a folder for temporary files of its own, and without an engine."""
    variables = {"TMPDIR": str(temporary), "PATH": str(temporary)}
    return subprocess.run(
        [sys.executable, "-I", "-m", "envhub_sandbox", "gc", *options],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=True,
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

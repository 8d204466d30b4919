"""``envhub cache gc``, as a user runs it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import psutil

from envhub_sandbox import make_env
from tests.faults.remains.traces import temporary_root
from tests.support.command_line import COMMAND
from tests.support.samples import sample


def gc(
    temporary: Path, *options: str, check: bool = True, before: Sequence[str] = ()
) -> subprocess.CompletedProcess[str]:
    """Run it with a folder for temporary files of its own, and without an engine."""
    variables = {"TMPDIR": str(temporary), "PATH": str(temporary)}
    return subprocess.run(
        [*before, *COMMAND, "cache", "gc", *options],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=check,
    )


def left_behind(temporary: Path) -> Path:
    """The folder of a container whose client has ended."""
    folder = temporary / "envhub-docker-abcd0123"
    folder.mkdir(mode=0o700)
    (folder / "alive").touch()  # whose lock no process holds
    return folder


def test_a_running_client_is_left_alone_in_every_namespace() -> None:
    """Its pid and its start time are other ones there; its lock is the same."""
    unshare = shutil.which("unshare")
    assert unshare is not None
    user = [] if os.geteuid() == 0 else ["--map-root-user"]
    apart = ["--time", "--boottime", "5000", "--pid", "--mount-proc", "--fork"]
    with temporary_root() as place:
        suites = make_env(sample("counter"), timeouts={"server_idle_s": 0})
        suites.env.reset(seed=1)
        mine = set(place.glob("envhub-*"))
        assert mine
        dead = left_behind(place)  # not before: a client that starts removes it
        done = gc(place, "--dry-run", "--json", before=[unshare, *user, *apart])
        found = {one["name"] for one in json.loads(done.stdout)["found"]}
        assert str(dead) in found
        assert not found & set(map(str, mine))
        servers = [one.pid for one in psutil.Process().children() if one.status() != "zombie"]
        assert not [name for name in found for pid in servers if f"_{pid}_" in name]
        suites.close()


def test_what_was_left_behind_is_removed(tmp_path: Path) -> None:
    """And said to be; the next run finds nothing. A dry run only names it."""
    folder = left_behind(tmp_path)
    assert f"found        folder {folder}" in gc(tmp_path, "--dry-run").stdout
    assert folder.exists()
    said = json.loads(gc(tmp_path, "--json").stdout)
    assert {"kind": "folder", "name": str(folder), "removed": True} in said["found"]
    assert not folder.exists()
    again = json.loads(gc(tmp_path, "--json").stdout)
    assert [one for one in again["found"] if one["kind"] == "folder"] == []


def test_an_engine_that_is_down_is_said_to_be_so(tmp_path: Path) -> None:
    """Nobody knows its containers; what else was left behind is removed all the same."""
    folder, program = left_behind(tmp_path), tmp_path / "docker"
    program.write_text('#!/bin/sh\necho "{\\"ServerVersion\\": \\"28\\"}"; [ $1 != ps ]\n')
    program.chmod(0o755)
    done = gc(tmp_path, check=False)
    assert done.returncode == 9
    assert "docker could not be asked, so its containers are not known" in done.stderr
    assert not folder.exists()
    again = gc(tmp_path, "--json", check=False)
    assert again.returncode == 9
    assert set(json.loads(again.stdout)["unasked"]) == {"docker"}

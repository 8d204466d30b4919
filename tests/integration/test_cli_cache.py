"""``envhub cache`` and ``envhub version``."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from envhub_sandbox import __version__
from envhub_sandbox.cli.app import app
from envhub_sandbox.cli.cache import stored_snapshots
from envhub_sandbox.hub import snapshot
from envhub_sandbox.hub.store import cache_root
from tests.support.repositories import write_repository

RUNNER = CliRunner()


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A store with three local snapshots, the last one used most recently; their commits."""
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "cache"))
    commits = []
    for age, name in enumerate("cba"):
        folder = write_repository(tmp_path / name, f"NAME = {name!r}\n")
        found = snapshot.local(folder)
        used = time.time() - 86400 * (2 - age)
        os.utime(found.root.parent / "record.json", (used, used))
        commits.append(found.commit)
    return commits[::-1]


def test_list_shows_what_is_stored(stored: list[str]) -> None:
    """The latest used first, with sizes."""
    done = RUNNER.invoke(app, ["cache", "list", "--json"])
    found = json.loads(done.stdout)
    assert [one["commit"] for one in found["snapshots"]] == stored
    assert all(one["bytes"] == len("NAME = 'a'\n") for one in found["snapshots"])
    assert found["folder"] == str(cache_root())
    text = RUNNER.invoke(app, ["cache", "list"]).stdout
    assert all(commit in text for commit in stored)


def test_hub_repositories_are_named_as_they_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the prefix of their type; folders that are no snapshots are left alone."""
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path))
    host = tmp_path / "snapshots" / "huggingface.co-12345678"
    for name in ("model--org--a", "space--org--b", "dataset--org--c"):
        home = host / name / ("f" * 40)
        home.mkdir(parents=True)
        record = {"format": 1, "revision": "main", "files": [["env.py", 7, "d", 0, 0, 0]]}
        (home / "record.json").write_text(json.dumps(record))
    broken = host / "model--org--d" / ("e" * 40)
    broken.mkdir(parents=True)
    (broken / "record.json").write_text("[")
    found = {one.repository: one for one in stored_snapshots()}
    assert set(found) == {"org/a", "spaces/org/b", "datasets/org/c"}
    assert found["org/a"].answers_to("org/a")
    assert found["org/a"].answers_to("org/a@ffff")
    assert found["org/a"].answers_to("f" * 7)
    assert not found["org/a"].answers_to("f" * 6)
    assert not found["org/a"].answers_to("org/b@ffff")


def test_remove_takes_only_what_is_named(stored: list[str]) -> None:
    """By the beginning of its commit."""
    done = RUNNER.invoke(app, ["cache", "remove", stored[1][:20]])
    assert done.exit_code == 0
    assert "Removed 1 snapshots" in done.stderr
    assert [one.commit for one in stored_snapshots()] == [stored[0], stored[2]]


def test_remove_takes_what_nobody_used(stored: list[str]) -> None:
    """Older than so many days."""
    RUNNER.invoke(app, ["cache", "remove", "--unused-for", "1.5"])
    assert [one.commit for one in stored_snapshots()] == stored[:2]


def test_remove_all_forgets_descriptions_too(stored: list[str]) -> None:
    """Snapshots and remembered manifests."""
    manifests = cache_root() / "manifests"
    manifests.mkdir()
    (manifests / "one").write_text("x")
    assert RUNNER.invoke(app, ["cache", "remove", "--all"]).exit_code == 0
    assert stored_snapshots() == []
    assert not manifests.exists()


def test_remove_of_an_unknown_name_is_usage(stored: list[str]) -> None:
    """And nothing is removed, whatever else was named."""
    done = RUNNER.invoke(app, ["cache", "remove", stored[0], "nobody/knows"])
    assert done.exit_code == 2
    assert "nobody/knows" in done.stderr
    assert len(stored_snapshots()) == 3


def test_version_names_everything_that_matters() -> None:
    """As text and as JSON."""
    versions = json.loads(RUNNER.invoke(app, ["version", "--json"]).stdout)
    assert versions["envhub-sandbox"] == __version__
    assert {"protocol", "python", "gymnasium", "huggingface_hub"} <= set(versions)
    for words in (["version"], ["--version"]):
        assert __version__ in RUNNER.invoke(app, words).stdout

"""The layout of a jail's cache of the Hub, as huggingface_hub reads it."""

from __future__ import annotations

from pathlib import Path

import pytest
from huggingface_hub import snapshot_download

from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.runtime import HubCopy
from envhub_worker.spawn.hub_cache import make_hub_cache

COMMIT = "ab" * 20


def spec_of(snapshot: Path, *copies: HubCopy, **environment: str) -> JailSpec:
    """A jail for these files."""
    confinement = Confinement(environment=environment)
    given = {"entry": "env.py", "confinement": confinement, "name": "x"}
    return JailSpec(snapshot=str(snapshot), hub_copies=copies, **given)


def test_the_snapshot_is_a_link_to_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every runner of a jail makes the same, and huggingface_hub finds it without a network."""
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    other = tmp_path / "other"
    own = HubCopy("models--org--repo", COMMIT, ("main", "refs/pr/3"), "")
    spec = spec_of(tmp_path, own, HubCopy("datasets--org--data", COMMIT, ("main",), str(other)))
    for _ in range(2):
        make_hub_cache(spec)
    hub = tmp_path / "hf/hub"
    assert (hub / "models--org--repo/refs/refs/pr/3").read_text() == COMMIT
    assert (hub / "models--org--repo/snapshots" / COMMIT).readlink() == tmp_path
    assert (hub / "datasets--org--data/snapshots" / COMMIT).readlink() == other
    found = snapshot_download("org/repo", cache_dir=hub, local_files_only=True)
    assert Path(found).resolve() == tmp_path.resolve()


def test_a_cache_that_the_caller_gives_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``policy={"environment": ["HF_HOME"]}`` names another one."""
    monkeypatch.setenv("HF_HOME", str(tmp_path / "theirs"))
    copy = HubCopy("models--org--repo", COMMIT, ("main",), "")
    make_hub_cache(spec_of(tmp_path, copy, HF_HOME=str(tmp_path / "theirs")))
    assert not (tmp_path / "theirs").exists()

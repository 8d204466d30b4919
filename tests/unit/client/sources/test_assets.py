"""What may be an asset: a repository of the Hub, once, and by a card's word a commit only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import (
    EnvHubError,
    HubReferenceError,
    RepositoryUnavailableError,
    SnapshotError,
)
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, fetch
from envhub_sandbox.hub.sources.assets import with_assets
from tests.hub.stub_hub import StubHub, StubRepository

COMMIT = StubRepository({}).commit
CARD = "---\nenvhub:\n  assets: [{}]\n---\n"


@pytest.fixture
def hub(stub_hub: StubHub, hub_cache: Path) -> dict[str, Any]:
    """A Hub with data, as ``fetch`` takes it."""
    stub_hub.add("org/data", {"mesh.txt": "a mesh"}, "dataset")
    return {"hub_cache_dir": hub_cache, "token": False, "endpoint": stub_hub.endpoint}


def own(stub_hub: StubHub, hub: dict[str, Any], *declared: str) -> Snapshot:
    """The environment's own files, with a card."""
    card = CARD.format(", ".join(declared))
    stub_hub.add("org/repo", {"env.py": "", "README.md": card if declared else "none"})
    return fetch(HubRef.parse("models/org/repo"), **hub)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("./folder", "a repository of the Hub"),
        ("pypi:pkg", "a repository of the Hub"),
        ("git+https://user:hf_secret@host/org/data", "a repository of the Hub"),
        ("https://user:hf_secret@huggingface.co/org/data", "user or token"),
        ("org/data:env.py", "names a file"),
        ("org/data@v1:x.py", "names a file"),
        ("data", "owner is missing"),
        ("ORG/repo", "own repository"),
        (f"models/org/repo@{COMMIT}", "own repository"),
    ],
)
def test_what_is_no_asset_is_refused_before_any_request(
    stub_hub: StubHub, hub: dict[str, Any], text: str, said: str
) -> None:
    """The error says who names it, and repeats no login."""
    snapshot = own(stub_hub, hub)
    before = len(stub_hub.requests)
    with pytest.raises(HubReferenceError, match=said) as caught:
        with_assets(snapshot, [text], hub)
    assert str(caught.value).startswith(f"{snapshot.label}: assets holds ")
    assert "hf_secret" not in str(caught.value)
    assert len(stub_hub.requests) == before


def test_one_repository_is_shown_at_one_commit(stub_hub: StubHub, hub: dict[str, Any]) -> None:
    """Twice is refused, also by another spelling; of no asset the snapshot is what it was."""
    snapshot = own(stub_hub, hub)
    assert with_assets(snapshot, [], hub) is snapshot
    [asset] = with_assets(snapshot, ["org/data"], hub).assets
    assert (asset.repo_type, asset.commit) == ("dataset", COMMIT)
    with pytest.raises(HubReferenceError, match="at one commit"):
        with_assets(snapshot, ["org/data", f"datasets/org/data@{COMMIT}"], hub)
    with pytest.raises(EnvHubError, match=r"It is an asset: assets names it\.$"):
        with_assets(snapshot, ["org/absent"], hub)


@pytest.mark.parametrize(
    ("declared", "kind", "said"),
    [
        ("org/data", HubReferenceError, "full commits only"),
        ("datasets/org/data@main", HubReferenceError, "full commits only"),
        ("{a: b}", SnapshotError, "is refused"),
        (f"org/absent@{COMMIT}", RepositoryUnavailableError, "fetched without a login"),
    ],
)
def test_a_card_may_name_public_commits_only(
    stub_hub: StubHub, hub: dict[str, Any], declared: str, kind: type[EnvHubError], said: str
) -> None:
    """What changes would be chosen by its author, and what is private is the caller's."""
    snapshot = own(stub_hub, hub, declared)
    with pytest.raises(kind, match=said):
        with_assets(snapshot, [], hub)

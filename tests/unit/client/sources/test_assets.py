"""What may be an asset: a repository of the Hub, once, and by a card's word a commit only. A card
is read as data, within bounds, and only in one form."""

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors
from envhub_sandbox.extras.sources.assets import CardError, declared_assets, with_assets
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, fetch
from tests.hub.stub_hub import StubHub, StubRepository

PIN = "a" * 40


def declared(folder: Path, text: str) -> list[str]:
    (folder / "README.md").write_text(text)
    return declared_assets(folder)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# a title\n",
        "---\nlicense: mit\n---\n",
        f"# not in front\n---\nenvhub:\n  assets: [org/data@{PIN}]\n---\n",
        f"---\nother:\n  envhub:\n    assets: [org/data@{PIN}]\n---\n",
        f"---\nenvhub:\n  assets: [org/data@{PIN}]\n",
    ],
)
def test_most_cards_declare_nothing(tmp_path: Path, text: str) -> None:
    assert declared(tmp_path, text) == []


def test_assets_are_a_list_of_texts(tmp_path: Path) -> None:
    rows = f"---\r\nenvhub:\r\n  assets:\r\n  - org/b@{PIN}\r\n  - datasets/org/a@x\r\n---\r\n"
    assert declared(tmp_path, rows) == [f"org/b@{PIN}", "datasets/org/a@x"]
    assert declared(tmp_path, '---\nenvhub: {assets: ["org/b", 5]}\n---\n') == ["org/b", "5"]


@pytest.mark.parametrize(
    ("yaml", "why"),
    [
        ("envhub: 5", "takes 'assets'"),
        ("envhub:\n  assets: org/data", "takes 'assets'"),
        ("envhub:\n  assets: [[org/data]]", "each of its assets is a text"),
        ("envhub:\n  assets: [org/" + "x" * 60_000 + "]", "has more than 500 characters"),
        ("envhub: [", "cannot be read"),
        ('envhub: {assets: ["\\UFFFFFFFF"]}', "cannot be read: (Overflow|Value)Error"),
        ("license: mit\nenvhub:\n\tassets: []", "cannot be read: ScannerError in line 4"),
        ("envhub:\n  assets: " + "[" * 5000, "cannot be read"),
        ("envhub:\n  assets:\n" + "  - org/data\n" * 10_000, "cannot be read|declares|at most"),
        ("envhub:\n  assets:\n" + "  - org/data\n" * 100, "it declares 100 assets, and at most 16"),
    ],
)
def test_another_form_is_refused(tmp_path: Path, yaml: str, why: str) -> None:
    """The text says what is wrong; deep nesting and thousands of rows cost next to nothing."""
    if len(yaml) > 64 << 10:
        assert declared(tmp_path, f"---\n{yaml}\n---\n") == []  # its end lies behind what is read
        return
    with pytest.raises(CardError, match=why):
        declared(tmp_path, f"---\n{yaml}\n---\n")


def test_merges_are_not_followed(tmp_path: Path) -> None:
    """Constructing thirty merges that double would take a billion pairs; nothing is constructed."""
    doubled = "".join(f"a{n + 1}: &a{n + 1}\n  <<: [*a{n}, *a{n}]\n" for n in range(30))
    with pytest.raises(CardError, match="takes 'assets'"):
        declared(tmp_path, f"---\na0: &a0 {{k: 1}}\n{doubled}envhub: *a30\nx: 1\n---\n")


def test_the_documented_card_is_read(tmp_path: Path) -> None:
    page = (Path(__file__).parents[4] / "docs" / "authors.md").read_text()
    block = next(one for one in page.split("```") if one.strip().startswith("---"))
    model, dataset = declared(tmp_path, block.lstrip())
    assert HubRef.parse(model).is_pinned
    assert HubRef.parse(dataset).repo_type == "dataset"


COMMIT = StubRepository({}).commit
CARD = "---\nenvhub:\n  assets: [{}]\n---\n"


@pytest.fixture
def hub(stub_hub: StubHub, hub_cache: Path) -> dict[str, Any]:
    """A Hub with data, as ``fetch`` takes it."""
    stub_hub.add("org/data", {"mesh.txt": "a mesh"}, "dataset")
    return {"hub_cache_dir": hub_cache, "token": False, "endpoint": stub_hub.endpoint}


def own(stub_hub: StubHub, hub: dict[str, Any], *declared: str) -> Snapshot:
    card = CARD.format(", ".join(declared))
    stub_hub.add("org/repo", {"env.py": "", "README.md": card if declared else "none"})
    return fetch(HubRef.parse("models/org/repo"), **hub)


@pytest.mark.parametrize("where", ["assets", "its README.md"])
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("./folder", "a repository of the Hub"),
        ("pypi:pkg", "a repository of the Hub"),
        ("git+https://user:hf_secret@host/org/data", "a repository of the Hub"),
        ("https://user:hf_secret@huggingface.co/org/data", "user or token"),
        ("org/data:env.py", "names a file"),
        ("org/data@v1:x.py", "names a file"),
        ("org/../data@" + "a" * 40, "holds"),
        ("/etc", "a repository of the Hub"),
        (f"git+https://127.0.0.1:9/org/data@{COMMIT}", "a repository of the Hub"),
        (f"https://github.com/org/data@{COMMIT}", "a repository of the Hub"),
        ("data", "owner is missing"),
        ("ORG/repo", "own repository"),
        (f"models/org/repo@{COMMIT}", "own repository"),
    ],
)
def test_what_is_no_asset_is_refused_before_any_request(
    stub_hub: StubHub, hub: dict[str, Any], text: str, said: str, where: str
) -> None:
    """By the caller's word and by a card's, which could have any server asked that we can reach."""
    snapshot = own(stub_hub, hub, *([f"'{text}'"] if where != "assets" else []))
    before = len(stub_hub.requests)
    with pytest.raises(errors.HubReferenceError, match=said) as caught:
        with_assets(snapshot, [text] if where == "assets" else [], hub)
    assert str(caught.value).startswith(f"{snapshot.label}: {where} holds ")
    assert "hf_secret" not in str(caught.value)
    assert len(stub_hub.requests) == before


def test_one_repository_is_shown_at_one_commit(stub_hub: StubHub, hub: dict[str, Any]) -> None:
    """Twice is refused, also by another spelling; of no asset the snapshot is what it was."""
    snapshot = own(stub_hub, hub)
    assert with_assets(snapshot, [], hub) is snapshot
    [asset] = with_assets(snapshot, ["org/data"], hub).assets
    assert (asset.repo_type, asset.commit) == ("dataset", COMMIT)
    with pytest.raises(errors.HubReferenceError, match="at one commit"):
        with_assets(snapshot, ["org/data", f"datasets/org/data@{COMMIT}"], hub)
    with pytest.raises(errors.EnvHubError, match=r"It is an asset: assets names it\.$"):
        with_assets(snapshot, ["org/absent"], hub)


@pytest.mark.parametrize(
    ("declared", "kind", "said"),
    [
        ("org/data", errors.HubReferenceError, "full commits only"),
        ("datasets/org/data@main", errors.HubReferenceError, "full commits only"),
        ("{a: b}", errors.SnapshotError, "is refused"),
        (f"org/absent@{COMMIT}", errors.RepositoryUnavailableError, "fetched without a login"),
    ],
)
def test_a_card_may_name_public_commits_only(
    stub_hub: StubHub, hub: dict[str, Any], declared: str, kind: type[errors.EnvHubError], said: str
) -> None:
    """What changes would be chosen by its author, and what is private is the caller's."""
    snapshot = own(stub_hub, hub, declared)
    with pytest.raises(kind, match=said):
        with_assets(snapshot, [], hub)

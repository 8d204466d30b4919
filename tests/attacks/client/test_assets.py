"""Cards and asset repositories that lie: what the client fetches for them, and shows to a jail.
A control follows the card as a loader without judgement would, with YAML's and huggingface_hub's
own functions. Judged at the Hub, which writes down who asked for what, and by what a jail can read.
"""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from huggingface_hub import hf_hub_download

from envhub_sandbox import errors, make_env
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.locks import lockfile
from envhub_sandbox.extras.packages.resolution.pylock import PylockPackage, Wheel
from envhub_sandbox.extras.sources import assets
from tests.hub.stub_hub import StubHub, StubRepository
from tests.support.repositories import STILL

COMMIT = StubRepository({}).commit
READS = f"""{STILL}
import os
class Reads(Still):
    def read(self, path):
        return open(path).read()

    def asset(self, repository):
        folder = os.environ["HF_HOME"] + "/hub/models--" + repository + "/snapshots/"
        return [open(folder + commit + "/x").read() for commit in os.listdir(folder)]

    def found(self):
        hub = os.environ["HF_HOME"] + "/hub"
        return sorted(os.listdir(hub)) if os.path.isdir(hub) else []
"""
Make = Callable[..., Any]


@pytest.fixture
def make(stub_hub: StubHub, hub_cache: Path) -> Make:
    """``make_env`` of org/repo with a card that declares these."""

    def run(*declared: str, **options: Any) -> Any:
        card = yaml.safe_dump({"envhub": {"assets": list(declared)}})
        stub_hub.add("org/repo", {"env.py": READS, "README.md": f"---\n{card}---\n"})
        given = {"endpoint": stub_hub.endpoint, "hub_cache_dir": hub_cache, "token": False}
        return make_env(f"org/repo@{COMMIT}", **{**given, **options})

    return run


def followed(stub_hub: StubHub, folder: Path, most: int, token: str | bool = False) -> list[str]:
    """The control: every asset that the card declares, fetched as huggingface_hub fetches it."""
    card = stub_hub.repositories["model", "org/repo"].files["README.md"].decode()
    texts = yaml.safe_load(card.split("---")[1])["envhub"]["assets"][:most]
    found = []
    for text in texts:
        repo, _, revision = text.partition("@")
        given = {"revision": revision, "cache_dir": folder, "token": token}
        with contextlib.suppress(Exception):
            path = hf_hub_download(repo, "x", endpoint=stub_hub.endpoint, **given)
            found.append(Path(path).read_text())
    return found


def asked_for(stub_hub: StubHub, word: str) -> list[str | None]:
    pairs = zip(stub_hub.requests, stub_hub.authorizations, strict=True)
    return [token for request, token in pairs if word in request]


@pytest.mark.parametrize("declared", [False, True])
def test_an_asset_that_lies_about_its_hashes(
    stub_hub: StubHub, make: Make, tmp_path: Path, declared: bool
) -> None:
    """The Hub serves other bytes for the pinned commit; a loader takes them, a jail never."""
    stub_hub.add("org/lies", {"x": "as listed"}).served["x"] = b"other bytes"
    asset = f"org/lies@{COMMIT}"
    with pytest.raises(errors.SnapshotIntegrityError, match="It is an asset"):
        make(*([asset] if declared else []), assets=[] if declared else [asset])
    make_card = yaml.safe_dump({"envhub": {"assets": [asset]}})
    stub_hub.repositories["model", "org/repo"].files["README.md"] = f"---\n{make_card}---".encode()
    assert followed(stub_hub, tmp_path / "control", 1) == ["other bytes"]


def test_a_card_declares_ten_thousand_assets(stub_hub: StubHub, make: Make, tmp_path: Path) -> None:
    """The Hub is asked for none of them; a loader asks for one after the other."""
    for number in range(5):
        stub_hub.add(f"org/many{number}", {"x": "x"})
    for count in (17, 10_000):
        many = [f"org/many{number}@{COMMIT}" for number in range(count)]
        with contextlib.suppress(errors.SnapshotError), make(*many) as suites:
            assert suites.env.call("found") == (["models--org--repo"],)
        assert not asked_for(stub_hub, "org/many")
    assert len(followed(stub_hub, tmp_path / "control", 5)) == 5
    assert asked_for(stub_hub, "org/many")


def test_cards_assets_share_what_one_repository_may_bring(
    stub_hub: StubHub, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixteen times four gigabytes would fill a disk; each alone would be taken."""
    limits = assets.replace(assets.DEFAULT_LIMITS, max_bytes=1500)
    monkeypatch.setattr(assets, "DEFAULT_LIMITS", limits)
    for number in range(2):
        stub_hub.add(f"org/large{number}", {"x": "x" * 1000})
    both = [f"org/large{number}@{COMMIT}" for number in range(2)]
    with pytest.raises(errors.SnapshotTooLargeError, match="org/large1"):
        make(*both)
    with make(assets=both) as suites:  # what the caller names has a limit of its own each
        assert len(suites.provenance["assets"]) == 2


def test_a_card_that_names_the_callers_private_repository(
    stub_hub: StubHub, make: Make, tmp_path: Path
) -> None:
    """The caller's token never goes out for a card's asset; by ``assets`` the caller may say so."""
    stub_hub.add("me/private", {"x": "secret"})
    with make(f"me/private@{COMMIT}", token="hf_mine"):
        assert set(asked_for(stub_hub, "me/private")) == {None}
        assert set(asked_for(stub_hub, "org/repo")) == {"Bearer hf_mine"}
    followed(stub_hub, tmp_path / "control", 1, token="hf_mine")
    assert "Bearer hf_mine" in asked_for(stub_hub, "me/private")


def locked(folder: Path, asset: str) -> Path:
    """A lock file that names an asset. It fits no repository, which is found out afterwards."""
    path = folder / "pylock.env.toml"
    package = PylockPackage("x", "1.0", (Wheel("0" * 64, "", None),))
    files = {"env.py": f"sha256:{'0' * 64}"}
    runner = lockfile.Runner.of(interpreters.own())
    lock = lockfile.LockFile("org/repo", COMMIT, "env.py", files, runner, (package,))
    lockfile.write(replace(lock, assets=(asset,)), path)
    return path


@pytest.mark.parametrize("kind", ["private", "gated"])
def test_what_the_callers_login_has_brought_is_no_strangers(
    stub_hub: StubHub, make: Make, tmp_path: Path, kind: str
) -> None:
    """The store has the commit, and so needs no request; for a card and a lock the Hub is asked all
    the same, whether everybody gets it. The control is the caller's own word."""
    mine = stub_hub.add("me/mine", {"x": "secret"})
    mine.token, mine.gated = ("hf_mine", False) if kind == "private" else ("", True)
    asset = f"me/mine@{COMMIT}"
    with make(asset, assets=[asset], token="hf_mine") as suites:
        assert suites.env.call("asset", "me--mine") == (["secret"],), "the control failed"
    before = len(stub_hub.requests)
    with pytest.raises(
        errors.RepositoryUnavailableError, match=r"README\.md names it, and it is fetched"
    ):
        make(asset, token="hf_mine")
    with pytest.raises(
        errors.RepositoryUnavailableError, match="the lock names it, and it is fetched"
    ):
        make(asset, token="hf_mine", lock=locked(tmp_path, asset))
    asked = zip(stub_hub.requests[before:], stub_hub.authorizations[before:], strict=True)
    assert {token for request, token in asked if "me/mine" in request} == {None}
    mine.token, mine.gated = "", False
    with make(asset, token="hf_mine") as suites:  # now that everybody gets it
        assert suites.env.call("asset", "me--mine") == (["secret"],)
    with pytest.raises(errors.LockDriftError):
        make(asset, token="hf_mine", lock=locked(tmp_path, asset))
    before = len(stub_hub.requests)
    make(asset, token="hf_mine").close()
    assert len(stub_hub.requests) == before, "what is known to be public is asked for again"


@pytest.mark.parametrize(
    ("asset", "why"),
    [
        (f"org/repo@{'a' * 40}", "own repository"),
        (f"ORG/Repo@{'a' * 40}", "own repository"),
        ("org/data", "full commits only"),
        ("org/data@main", "full commits only"),
        (f"org/data@{COMMIT[:12]}", "full commits only"),
        (f"../../etc@{COMMIT}", "holds"),
        (f"org/..@{COMMIT}", "holds"),
        ("org/data@../../x", "holds|full commits"),
        ("./data", "holds"),
        ("/etc", "holds"),
        (f"org/data@{COMMIT}:env.py", "names a file"),
        ("https://user:pw@evil.example/org/data", "holds"),
    ],
)
def test_a_card_names_what_is_no_asset(stub_hub: StubHub, make: Make, asset: str, why: str) -> None:
    """Its own id at another commit, a moving revision, paths, and other hosts: nothing is asked."""
    with pytest.raises(errors.HubReferenceError, match=why) as caught:
        make(asset)
    assert "org/repo" in str(caught.value)
    assert not asked_for(stub_hub, "data")
    assert "pw" not in str(caught.value)


def test_two_names_for_one_repository(stub_hub: StubHub, make: Make) -> None:
    stub_hub.add("org/data", {"x": "x"}).earlier["b" * 40] = {"x": b"y"}
    with pytest.raises(errors.EnvHubError, match="shown once, at one commit"):
        make(f"org/data@{COMMIT}", f"models/org/data@{'b' * 40}")
    with make(f"org/data@{'b' * 40}", assets=[f"org/data@{COMMIT}"]) as suites:
        assert suites.provenance["assets"] == [f"org/data@{COMMIT}"]  # the caller's goes first


def test_the_callers_own_cache_of_the_hub_stays_out_of_reach(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = tmp_path / "mine" / "token"
    token.parent.mkdir()
    token.write_text("hf_mine")
    monkeypatch.setenv("HF_HOME", str(token.parent))
    scope: dict[str, Any] = {}
    exec(READS, scope)
    assert scope["Reads"]().read(token) == "hf_mine"
    with make() as suites:
        assert suites.env.call("found") == (["models--org--repo"],)
        with pytest.raises(FileNotFoundError):
            suites.env.call("read", str(token))

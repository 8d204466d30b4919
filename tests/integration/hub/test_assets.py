"""What an environment finds in its cache of the Hub: its own files, and assets; in a jail."""

import pickle
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvError
from envhub_sandbox.system.folders import remove_tree
from tests.hub.stub_hub import StubHub, StubRepository
from tests.support.interpreter import profiles
from tests.support.repositories import STILL

DATA = "d" * 40
ENV = f"""{STILL}
from pathlib import Path
from huggingface_hub import hf_hub_download, snapshot_download

class Downloads(Still):
    def here(self, repo, kind=None, revision=None):
        folder = Path(snapshot_download(repo, repo_type=kind, revision=revision))
        return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())

    def text(self, repo, name, kind=None):
        return Path(hf_hub_download(repo, name, repo_type=kind)).read_text()

    def write(self, repo, kind=None):
        (Path(snapshot_download(repo, repo_type=kind)) / "mesh.txt").write_text("changed")

snapshot_download(OWN)
"""
Make = Callable[..., Any]


def env_of(own: str) -> str:
    """An environment that downloads its own repository while it is imported."""
    return ENV.replace("OWN", repr(own))


@pytest.fixture
def own(stub_hub: StubHub) -> StubRepository:
    """The environment's own repository, and one with data."""
    stub_hub.add("org/data", {"mesh.txt": "a mesh"}, "dataset").commit = DATA
    return stub_hub.add("org/repo", {"env.py": env_of("org/repo"), "scene/a.txt": "a scene"})


@pytest.fixture
def make(stub_hub: StubHub, hub_cache: Path, own: StubRepository) -> Make:
    def run(ref: str = f"org/repo@{StubRepository({}).commit}", **options: Any) -> Any:
        given = {"endpoint": stub_hub.endpoint, "hub_cache_dir": hub_cache, "token": False}
        return make_env(ref, **{**given, **options})

    return run


@pytest.mark.parametrize("ref", ["org/repo@v1.0", f"org/repo@{StubRepository({}).commit}"])
def test_downloads_of_the_own_id_are_the_pin(make: Make, own: StubRepository, ref: str) -> None:
    """``snapshot_download`` and ``hf_hub_download`` find them, by no revision, main and commit, and
    by the tag of the reference; another one is not inside."""
    own.refs.add("v1.0")
    tags = ["v1.0"] if "v1.0" in ref else []
    with make(ref) as suites:
        for revision in (None, "main", own.commit, *tags):
            [found] = suites.env.call("here", "org/repo", None, revision)
            assert found == ["env.py", "scene/a.txt"]
        assert suites.env.call("text", "org/repo", "scene/a.txt") == ("a scene",)
        with pytest.raises(RemoteEnvError):
            suites.env.call("here", "org/repo", None, "v2.0")


@pytest.mark.parametrize("kind", ["space", "dataset"])
def test_other_repository_types_find_themselves(make: Make, stub_hub: StubHub, kind: str) -> None:
    code = ENV.replace("snapshot_download(OWN)", f"snapshot_download('org/x', repo_type={kind!r})")
    stub_hub.add("org/x", {"env.py": code}, kind)
    with make(f"{kind}s/org/x") as suites:
        assert suites.env.call("here", "org/x", kind) == (["env.py"],)
        with pytest.raises(RemoteEnvError):
            suites.env.call("here", "org/x", "model")


@pytest.mark.parametrize("asset", [f"datasets/org/data@{DATA}", "org/data"])
def test_an_asset_is_found_and_read_only(make: Make, asset: str) -> None:
    """It has its own type; what runs without a network can read it and not change it."""
    with make(assets=[asset]) as suites:
        assert suites.env.call("text", "org/data", "mesh.txt", "dataset") == ("a mesh",)
        with pytest.raises(OSError, match=r"Read-only|Permission"):
            suites.env.call("write", "org/data", "dataset")
        assert suites.provenance["assets"] == [f"datasets/org/data@{DATA}"]


@pytest.fixture
def open_store(snapshot_store: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A store that other users may read, such as those of root's jails."""
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:
        Path(folder).chmod(0o755)
        monkeypatch.setenv("ENVHUB_CACHE", folder)
        yield
        remove_tree(Path(folder) / "snapshots")


@pytest.mark.usefixtures("open_store")
@pytest.mark.parametrize("profile", profiles("no-userns"))
def test_a_profile_without_mounts_shows_an_asset_too(make: Make, profile: str) -> None:
    """By Landlock; and every process of an environment that is spread finds it."""
    options = {"policy": {"profile": profile}, "n_envs": 4, "use_async_envs": True}
    options["num_workers"] = 2
    with make(assets=["org/data"], **options) as suites:
        assert suites.env.call("text", "org/data", "mesh.txt", "dataset") == ("a mesh",) * 4
        with pytest.raises(OSError, match=r"Read-only|Permission"):
            suites.env.call("write", "org/data", "dataset")


def test_assets_are_part_of_what_is_remembered_and_handed_on(make: Make) -> None:
    """With an asset and without it are two manifests; a pickle makes the same again, pinned."""
    with make() as suites, pytest.raises(RemoteEnvError):
        suites.env.call("text", "org/data", "mesh.txt", "dataset")
    with make(assets=["org/data"]) as suites:
        again = pickle.loads(pickle.dumps(suites.env))
        try:
            assert again.call("text", "org/data", "mesh.txt", "dataset") == ("a mesh",)
        finally:
            again.close()


@pytest.mark.parametrize("login", ["", "me:hf_secret@"])
def test_a_cards_assets(make: Make, stub_hub: StubHub, own: StubRepository, login: str) -> None:
    """They are fetched with neither a token nor a mirror's login, and the provenance has them."""
    own.files["README.md"] = f"---\nenvhub:\n  assets: [org/data@{DATA}]\n---\n# x\n".encode()
    endpoint = stub_hub.endpoint.replace("://", f"://{login}")
    with make(token=not login and "hf_secret", endpoint=endpoint) as suites:
        assert suites.env.call("text", "org/data", "mesh.txt", "dataset") == ("a mesh",)
        assert suites.provenance["assets"] == [f"datasets/org/data@{DATA}"]
    asked = zip(stub_hub.requests, stub_hub.authorizations, strict=True)
    tokens = {"data" if "org/data" in one else "own": token for one, token in asked}
    assert tokens["own"] is not None
    assert tokens["data"] is None

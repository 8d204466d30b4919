"""The real huggingface_hub client against real git repositories, served on loopback."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from envhub_sandbox.errors import RepositoryUnavailableError
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, commit_of, fetch
from tests.hub.olah_server import GitRepository, OlahServer
from tests.hub.stub_hub import git_blob_id

pytestmark = pytest.mark.same_for("users")

FILES = {
    "env.py": "from pkg.maker import make_env\n",
    "pkg/maker.py": "def make_env(n_envs=1, use_async_envs=False): ...\n",
    "pkg/data/map.txt": "....\n",
    "README.md": "---\nlicense: mit\n---\n",
    "empty": "",
}

Fetch = Callable[..., Snapshot]


@pytest.fixture
def get(olah: OlahServer, hub_cache: Path) -> Fetch:
    """``fetch`` from olah, with caches of this test only."""

    def run(text: str) -> Snapshot:
        return fetch(
            HubRef.parse(text), hub_cache_dir=hub_cache, token=False, endpoint=olah.endpoint
        )

    return run


def make(olah: OlahServer, name: str, repo_type: str = "model") -> GitRepository:
    """A repository of its own for one test."""
    return olah.repository(f"org/{name}", repo_type)


def contents(snapshot: Snapshot) -> dict[str, bytes]:
    """What lies on disk below the root."""
    return {
        str(path.relative_to(snapshot.root)): path.read_bytes()
        for path in snapshot.root.rglob("*")
        if path.is_file()
    }


def test_whole_repository_arrives_verified(olah: OlahServer, get: Fetch) -> None:
    """Every file of the commit is there, in sub-folders too, with its git blob id."""
    commit = make(olah, "whole").commit(FILES)
    snapshot = get("org/whole")
    expected = {path: text.encode() for path, text in FILES.items()}
    assert contents(snapshot) == expected
    assert (snapshot.repo_id, snapshot.repo_type) == ("org/whole", "model")
    assert (snapshot.commit, snapshot.path) == (commit, "env.py")
    assert {f.path: f.digest for f in snapshot.files} == {
        path: f"git-sha1:{git_blob_id(content)}" for path, content in expected.items()
    }


def test_branch_tag_and_short_commit_name_the_full_commit(olah: OlahServer, get: Fetch) -> None:
    """Whatever names a commit, the snapshot says which one it is."""
    repository = make(olah, "names")
    first = repository.commit({"env.py": "1"}, tag="v1")
    second = repository.commit({"env.py": "2"})
    other = repository.commit({"env.py": "3"}, branch="dev")
    found = {text: get(f"org/names@{text}") for text in ("v1", "main", "dev", first[:8], second)}
    assert {text: snapshot.commit for text, snapshot in found.items()} == {
        "v1": first,
        "main": second,
        "dev": other,
        first[:8]: first,
        second: second,
    }
    assert contents(found["v1"]) == {"env.py": b"1"}
    assert contents(found["dev"]) == {"env.py": b"3"}


@pytest.mark.short
@pytest.mark.parametrize("repo_type", ["model", "space", "dataset"])
def test_each_repository_type_loads(olah: OlahServer, get: Fetch, repo_type: str) -> None:
    """Models, spaces and datasets load by their prefix."""
    make(olah, f"typed-{repo_type}", repo_type).commit({"env.py": repo_type})
    snapshot = get(f"{repo_type}s/org/typed-{repo_type}")
    assert snapshot.repo_type == repo_type
    assert contents(snapshot) == {"env.py": repo_type.encode()}


@pytest.mark.parametrize(
    ("made", "found"),
    [
        # LeRobot's documentation has authors upload spaces
        ({"space": "env.py"}, "space"),
        # where both exist, the plain name means the model, as in LeRobot
        ({"model": "env.py", "space": "env.py"}, "model"),
        # a model of weights beside it does not hide the environment
        ({"model": "model.bin", "space": "env.py"}, "space"),
    ],
    ids=["only a space", "both", "weights"],
)
def test_a_plain_name_finds_the_environment(
    olah: OlahServer, get: Fetch, made: dict[str, str], found: str
) -> None:
    """The model where it has one, or else the space; a prefix finds what it names."""
    name = f"plain-{len(made)}-{found}"
    for repo_type, file in made.items():
        make(olah, name, repo_type).commit({file: repo_type})
    assert get(f"org/{name}").repo_type == found
    assert get(f"spaces/org/{name}").repo_type == "space"


def test_lfs_file_is_verified_by_its_sha256(olah: OlahServer, get: Fetch) -> None:
    """An LFS file arrives as its content, not as the pointer, and is checked by SHA-256."""
    content = os.urandom(300_000)
    make(olah, "lfs").commit({"env.py": ""}, lfs={"assets/mesh.bin": content})
    snapshot = get("org/lfs")
    assert (snapshot.root / "assets/mesh.bin").read_bytes() == content
    record = next(f for f in snapshot.files if f.path == "assets/mesh.bin")
    assert (record.size, record.digest.partition(":")[0]) == (len(content), "sha256")


def test_entry_in_a_sub_folder(olah: OlahServer, get: Fetch) -> None:
    """The path of the reference is the entry, and the whole repository comes along."""
    make(olah, "sub").commit({"envs/a-b/my env.py": "1", "shared.py": "2"})
    snapshot = get("org/sub:envs/a-b/my env.py")
    assert snapshot.path == "envs/a-b/my env.py"
    assert (snapshot.root / "shared.py").exists()


def test_pinned_and_stored_costs_no_request(olah: OlahServer, get: Fetch) -> None:
    """The second fetch of a full commit asks nobody."""
    commit = make(olah, "pinned").commit(FILES)
    first = get("org/pinned")
    before = len(olah.requests())
    assert get(f"org/pinned@{commit}") == first
    assert len(olah.requests()) == before


def test_branch_is_asked_for_every_time(olah: OlahServer, get: Fetch) -> None:
    """A branch that moved is seen at once, and one that did not is not downloaded again."""
    repository = make(olah, "moving")
    repository.commit({"env.py": "1"})
    first = get("org/moving")
    before = len(olah.requests())
    assert get("org/moving") == first
    asked = olah.requests()[before:]
    assert asked == ["GET /api/models/org/moving/revision/main"]
    repository.commit({"env.py": "2"})
    assert contents(get("org/moving")) == {"env.py": b"2"}


def test_a_commit_is_named_without_a_download(
    olah: OlahServer, get: Fetch, hub_cache: Path
) -> None:
    """What a branch means now; a full commit means itself, also where there is no Hub."""
    repository = make(olah, "named")
    where = {"hub_cache_dir": hub_cache, "token": False, "endpoint": olah.endpoint}
    first = repository.commit(FILES)
    assert commit_of("org/named", **where) == first
    second = repository.commit({"env.py": "# changed"})
    assert commit_of("org/named@main", **where) == second
    assert commit_of(f"org/named@{first}", endpoint="http://127.0.0.1:1") == first
    assert not list(hub_cache.rglob("env.py"))
    assert get("org/named").commit == second
    with pytest.raises(RepositoryUnavailableError):
        commit_of("org/nowhere", **where)


def test_missing_entry_lists_the_python_files_before_downloading(
    olah: OlahServer, get: Fetch
) -> None:
    """A wrong path is refused by the listing, with the paths that would work."""
    make(olah, "listing").commit({"envs/cartpole.py": "", "tools/x.py": "", "big.txt": "b"})
    before = len(olah.requests())
    with pytest.raises(RepositoryUnavailableError) as caught:
        get("models/org/listing:envs/cartpol.py")
    message = str(caught.value)
    assert "no file 'envs/cartpol.py'" in message
    assert "':envs/cartpole.py'; it has 'envs/cartpole.py', 'tools/x.py'" in message
    assert not any("/resolve/" in request for request in olah.requests()[before:])


def test_missing_everywhere_mentions_model_and_space(olah: OlahServer, get: Fetch) -> None:
    """Where neither exists, the error says that both were tried."""
    with pytest.raises(RepositoryUnavailableError) as caught:
        get("org/nowhere")
    message = str(caught.value)
    assert "no model repository org/nowhere" in message
    assert "no space repository org/nowhere" in message
    assert "'datasets/org/nowhere'" in message
    assert type(caught.value.__cause__).__name__ == "RepositoryNotFoundError"


def test_git_symlink_arrives_as_its_text_and_points_nowhere(olah: OlahServer, get: Fetch) -> None:
    """A link in the repository becomes a regular file that holds the link's text."""
    repository = make(olah, "linked")
    repository.commit({"env.py": "1"})
    (repository.folder / "outside").symlink_to("/etc/passwd")
    repository.commit({"a.py": "2"})
    snapshot = get("org/linked")
    assert not (snapshot.root / "outside").is_symlink()
    assert (snapshot.root / "outside").read_bytes() == b"/etc/passwd"


def test_threads_share_one_snapshot(olah: OlahServer, get: Fetch) -> None:
    """Concurrent fetches of the same commit all succeed and leave one copy."""
    make(olah, "threads").commit(FILES)
    with ThreadPoolExecutor(6) as pool:
        snapshots = list(pool.map(get, ["org/threads"] * 6))
    assert len(set(snapshots)) == 1
    home = snapshots[0].root.parent
    assert [path.name for path in home.parent.iterdir()] == [home.name]


def test_processes_share_one_snapshot(
    olah: OlahServer, hub_cache: Path, snapshot_store: Path
) -> None:
    """Concurrent processes all succeed and leave one copy."""
    commit = make(olah, "processes").commit(FILES)
    code = (
        "import sys; from envhub_sandbox.hub.snapshot import fetch; "
        "from envhub_sandbox.hub.reference import HubRef; "
        "print(fetch(HubRef.parse('org/processes'), hub_cache_dir=sys.argv[1], token=False,"
        " endpoint=sys.argv[2]).commit)"
    )
    command = [sys.executable, "-c", code, str(hub_cache), olah.endpoint]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert [process.communicate()[0].strip() for process in running] == [commit] * 3
    homes = list(snapshot_store.glob("snapshots/*/model--org--processes/*"))
    assert [home.name for home in homes] == [commit]

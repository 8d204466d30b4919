"""The real huggingface_hub client against real git repositories, served on loopback."""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from envhub_sandbox.errors import RepositoryUnavailableError
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, fetch
from tests.hub.olah_server import GitRepository, OlahServer
from tests.hub.stub_hub import git_blob_id

FILES = {
    "env.py": "from pkg.maker import make_env\n",
    "pkg/maker.py": "def make_env(n_envs=1, use_async_envs=False): ...\n",
    "pkg/data/map.txt": "....\n",
    "envs/a-b/my env.py": "1",
    "README.md": "---\nlicense: mit\n---\n",
    "empty": "",
}
Fetch = Callable[..., Snapshot]


@pytest.fixture
def get(olah: OlahServer, hub_cache: Path) -> Fetch:
    def run(text: str) -> Snapshot:
        return fetch(
            HubRef.parse(text), hub_cache_dir=hub_cache, token=False, endpoint=olah.endpoint
        )

    return run


def make(olah: OlahServer, name: str, repo_type: str = "model") -> GitRepository:
    return olah.repository(f"org/{name}", repo_type)


def contents(snapshot: Snapshot) -> dict[str, bytes]:
    return {
        str(path.relative_to(snapshot.root)): path.read_bytes()
        for path in snapshot.root.rglob("*")
        if path.is_file()
    }


def test_whole_repository_arrives_verified(olah: OlahServer, get: Fetch) -> None:
    """Every file of the commit is there, in sub-folders too, with its git blob id; of LFS the
    content, by its SHA-256. A link is a file with its text; the reference's path is the entry."""
    repository, mesh = make(olah, "whole"), os.urandom(300_000)
    repository.commit({"env.py": "1"})
    (repository.folder / "outside").symlink_to("/etc/passwd")
    commit = repository.commit(FILES, lfs={"assets/mesh.bin": mesh})
    snapshot = get("org/whole:envs/a-b/my env.py")
    expected = {path: text.encode() for path, text in FILES.items()}
    expected |= {"outside": b"/etc/passwd"}
    found = contents(snapshot)
    assert found.pop("assets/mesh.bin") == mesh
    assert {path: found[path] for path in expected} == expected
    assert not (snapshot.root / "outside").is_symlink()
    assert (snapshot.repo_id, snapshot.repo_type) == ("org/whole", "model")
    assert (snapshot.commit, snapshot.path) == (commit, "envs/a-b/my env.py")
    digests = {f.path: f.digest for f in snapshot.files}
    for path, content in expected.items():
        assert digests[path] == f"git-sha1:{git_blob_id(content)}"
    record = next(f for f in snapshot.files if f.path == "assets/mesh.bin")
    assert (record.size, record.digest.partition(":")[0]) == (len(mesh), "sha256")


def test_branch_tag_and_short_commit_name_the_full_commit(olah: OlahServer, get: Fetch) -> None:
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
    assert (contents(found["v1"]), contents(found["dev"])) == ({"env.py": b"1"}, {"env.py": b"3"})


@pytest.mark.parametrize("repo_type", ["model", "space", "dataset"])
def test_each_repository_type_loads(olah: OlahServer, get: Fetch, repo_type: str) -> None:
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


def test_branch_is_asked_for_every_time(olah: OlahServer, get: Fetch) -> None:
    """A branch that moved is seen at once, and one that did not is not downloaded again; of a full
    commit that is here nobody is asked."""
    repository = make(olah, "moving")
    repository.commit({"env.py": "1"})
    first = get("org/moving")
    before = len(olah.requests())
    assert get("org/moving") == first
    asked = olah.requests()[before:]
    assert asked == ["GET /api/models/org/moving/revision/main"]
    assert get(f"org/moving@{first.commit}") == first
    assert len(olah.requests()) == before + 1
    repository.commit({"env.py": "2"})
    assert contents(get("org/moving")) == {"env.py": b"2"}


def test_missing_entry_lists_python_files_before_downloading(olah: OlahServer, get: Fetch) -> None:
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
    with pytest.raises(RepositoryUnavailableError) as caught:
        get("org/nowhere")
    message = str(caught.value)
    assert "no model repository org/nowhere" in message
    assert "no space repository org/nowhere" in message
    assert "'datasets/org/nowhere'" in message
    assert type(caught.value.__cause__).__name__ == "RepositoryNotFoundError"


def test_threads_share_one_snapshot(olah: OlahServer, get: Fetch) -> None:
    make(olah, "threads").commit(FILES)
    with ThreadPoolExecutor(6) as pool:
        snapshots = list(pool.map(get, ["org/threads"] * 6))
    assert len(set(snapshots)) == 1
    home = snapshots[0].root.parent
    assert [path.name for path in home.parent.iterdir()] == [home.name]


def test_processes_share_a_copy(olah: OlahServer, hub_cache: Path, snapshot_store: Path) -> None:
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

"""``git+https://host/org/repo@commit:path``: a repository of git as one of the Hub."""

import json
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import LoadError, RepositoryUnavailableError, SnapshotTooLargeError
from envhub_sandbox.extras.packages.locks.day import written
from envhub_sandbox.extras.sources import git_address as address
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import SnapshotLimits, fetch, snapshot_named
from tests.support.command_line import document, envhub
from tests.support.packages.git_server import commit, git, git_served, make_repository
from tests.support.repositories import CARTPOLE, CARTPOLES

pytestmark = [pytest.mark.skipif(shutil.which("git") is None, reason="needs git")]


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """One with an environment below its root, a tag, and a commit after that."""
    folder = tmp_path / "served" / "org" / "repo"
    make_repository(folder, {"envs/env.py": CARTPOLE, "envs/asset.bin": "x" * 5000})
    git(folder, "tag", "-a", "v1", "-m", "x")
    (folder / "later.txt").write_text("later")
    commit(folder)
    return folder


@pytest.fixture(autouse=True)
def _permitted(snapshot_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address, "PROTOCOLS", ("http",))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


@pytest.fixture
def ref(repository: Path, tmp_path: Path) -> Iterator[str]:
    """Its reference without a revision, as long as it is served."""
    with git_served(tmp_path / "served") as where:
        yield f"git+{where}/org/repo"


_RUNS_A_PROGRAM = f"""
import pathlib
from subprocess import check_output
{CARTPOLES}
PROGRAM = pathlib.Path(__file__).parent / "bin" / "count"

def make_env(n_envs=1, use_async_envs=False):
    return {{check_output([PROGRAM], text=True): {{0: cartpoles(n_envs)}}}}
"""


def test_a_program_of_a_commit_or_a_folder_can_be_run(ref: str, repository: Path) -> None:
    """The Hub does not list which files are programs; the error says what to do there."""
    (repository / "envs/bin").mkdir()
    (repository / "envs/bin/count").write_text("#!/bin/sh\nprintf suite\n")
    (repository / "envs/env.py").write_text(_RUNS_A_PROGRAM)
    (repository / "envs/bin/count").chmod(0o755)
    commit(repository)
    for reference in (f"{ref}:envs/env.py", str(repository / "envs")):
        with make_env(reference) as suites:
            assert list(suites) == ["suite"]
    (repository / "envs/bin/count").chmod(0o644)
    with pytest.raises(LoadError, match=r"os\.chmod\(path, 0o755\) .* to be written or run"):
        make_env(str(repository / "envs"))


def test_it_runs_and_says_what_ran(ref: str, repository: Path, tmp_path: Path) -> None:
    """By a tag; the provenance has the commit, and a pickle makes that one again."""
    tagged = git(repository, "rev-parse", "v1^{commit}")
    with make_env(f"{ref}@v1:envs/env.py", n_envs=2) as suites:
        suites.env.reset(seed=0)
        suites.env.step(suites.env.action_space.sample())
        provenance, again = suites.provenance, suites.reference
        pickled = pickle.dumps(suites.env)
    assert provenance["repository"] == ref.removeprefix("git+")
    assert (provenance["repo_type"], provenance["commit"]) == ("git", tagged)
    blob = git(repository, "rev-parse", "v1:envs/env.py")
    assert provenance["files"]["envs/env.py"] == f"git-sha1:{blob}"
    assert "later.txt" not in provenance["files"]
    assert again == f"{ref}@{tagged}:envs/env.py"
    env = pickle.loads(pickled)
    env.reset(seed=0)
    env.close()


def test_a_pin_that_is_there_asks_nobody(repository: Path, tmp_path: Path) -> None:
    """A branch is asked for each time; what is in the store is named where nobody answers."""
    with git_served(tmp_path / "served") as where:
        ref = f"git+{where}/org/repo"
        first = snapshot_named(f"{ref}@main:envs/env.py")
        assert first.commit == git(repository, "rev-parse", "main")
        assert written(first) == "2026-01-01"  # by the commit, in UTC, without its files
    assert written(first) == "2026-01-01"
    assert snapshot_named(f"{ref}@{first.commit}:envs/env.py") == first
    with pytest.raises(RepositoryUnavailableError, match="ls-remote failed") as caught:
        snapshot_named(f"{ref}@main:envs/env.py")
    assert f"'{ref}@{first.commit}:envs/env.py' (main" in str(caught.value)


@pytest.mark.parametrize(
    ("behind", "said"),
    [
        ("", "has no file 'env.py'. Name the entry file after a colon, as in ':envs/env.py'"),
        ("@v9:envs/env.py", "no tag or branch 'v9'. Write all 40 digits of a commit"),
        ("@0123456:envs/env.py", "Write all 40 digits"),
        (f"@{'1' * 40}:envs/env.py", "git fetch failed"),
    ],
)
def test_what_is_not_there(ref: str, behind: str, said: str) -> None:
    with pytest.raises(RepositoryUnavailableError) as caught:
        make_env(f"{ref}{behind}")
    assert said in str(caught.value)
    if not behind:
        with pytest.raises(SnapshotTooLargeError, match=r"asset\.bin"):  # by the listing
            fetch(HubRef.parse(f"{ref}:envs/env.py"), limits=SnapshotLimits(max_file_bytes=4000))


def test_commands_know_it(ref: str, repository: Path, tmp_path: Path) -> None:
    pin = f"{ref}@{git(repository, 'rev-parse', 'v1^{commit}')}:envs/env.py"
    newest = f"{ref}@{git(repository, 'rev-parse', 'main')}:envs/env.py"
    lock = str(tmp_path / "pylock.x.toml")
    assert document("lock", pin, "-o", lock, "--no-spaces")["reference"] == pin
    assert document("lock", "--check", lock, "--no-index", "--no-spaces")["drift"] == []
    drift = document("lock", "--check", lock, newest, "--no-index", "--no-spaces", code=7)["drift"]
    assert "file later.txt: new" in drift
    changes = document("diff", pin, newest, code=7)
    assert "later.txt" in json.dumps(changes)
    assert document("inspect", pin)["provenance"]["repo_type"] == "git"
    judged = envhub("check", f"{ref}@main:envs/env.py", "--steps", "20")
    assert "can mean another commit" in " ".join((judged.stdout + judged.stderr).split())
    listed = [one["repository"] for one in document("cache", "list")["snapshots"]]
    assert set(listed) == {ref}

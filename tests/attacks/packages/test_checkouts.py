"""A stranger's checkout, whose ``.git`` names programs that git runs: judging it runs none."""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from envhub_sandbox.extras.judge.static import static
from envhub_sandbox.extras.sources.checkout import read_checkout
from envhub_sandbox.hub.snapshot import snapshot_named
from tests.hub.olah_server import GitRepository
from tests.support.packages.git_server import ran

pytestmark = [pytest.mark.skipif(shutil.which("git") is None, reason="needs git")]


@pytest.fixture
def checkout(tmp_path: Path, snapshot_store: Path) -> GitRepository:
    """One with a folder of its own for its snapshots."""
    made = GitRepository(tmp_path / "hostile")
    made.commit({"env.py": "def make_env(): pass", "far/data.txt": "x", "sub/x.py": ""})
    return made


def watched(repository: GitRepository, program: Path) -> list[str]:
    """Git asks it what has changed."""
    repository.git("config", "core.fsmonitor", str(program))
    return ["ls-files", "--modified"]


def hooked(repository: GitRepository, program: Path) -> list[str]:
    """Git runs it where it writes its index."""
    hooks = program.parent / "hooks"
    hooks.mkdir()
    for name in ("post-index-change", "pre-commit", "post-checkout"):
        shutil.copy(program, hooks / name)
    repository.git("config", "core.hooksPath", str(hooks))
    os.utime(repository.folder / "env.py", (0, 0))
    return ["status"]


def filtered(repository: GitRepository, program: Path) -> list[str]:
    repository.git("config", "filter.mine.clean", str(program))
    (repository.folder / ".gitattributes").write_text("*.py filter=mine\n")
    os.utime(repository.folder / "env.py", (0, 0))
    return ["status"]


def fetched(repository: GitRepository, program: Path) -> list[str]:
    """Git fetches by it what a sparse checkout's index needs and its objects lack."""
    repository.git("sparse-checkout", "set", "--cone", "--sparse-index", "sub")
    tree = repository.git("rev-parse", "HEAD:far")
    (repository.folder / ".git/objects" / tree[:2] / tree[2:]).unlink()
    for name, value in (
        ("remote.origin.url", f"ext::{program}"),
        ("remote.origin.promisor", "true"),
        ("protocol.ext.allow", "always"),
        ("core.repositoryFormatVersion", "1"),
        ("extensions.partialClone", "origin"),
    ):
        repository.git("config", name, value)
    return ["ls-files"]


@pytest.mark.parametrize("trap", [watched, hooked, filtered, fetched])
def test_no_program_of_a_checkout_runs(
    checkout: GitRepository, program: Path, trap: Callable[[GitRepository, Path], list[str]]
) -> None:
    command = ["git", "-C", str(checkout.folder), *trap(checkout, program)]
    subprocess.run(command, capture_output=True, check=False, stdin=subprocess.DEVNULL, timeout=60)
    assert ran(program)
    read = static(snapshot_named(str(checkout.folder)))
    assert "env.py" in {one.record.path for one in read.files}
    assert not ran(program)


def test_a_checkout_does_not_choose_the_folder(checkout: GitRepository, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home/secret.txt").write_text("secret")
    checkout.git("config", "core.worktree", str(tmp_path / "home"))
    listing = ("ls-files", "--others", "--exclude-standard")
    assert checkout.git(*listing, ":/") == "secret.txt"
    (checkout.folder / "new.py").write_text("")
    found = read_checkout(checkout.folder)
    assert found.files == {"env.py", "far/data.txt", "new.py", "sub/x.py"}


def test_what_is_ignored_cannot_hold_the_client(checkout: GitRepository) -> None:
    (checkout.folder / "hidden.py").write_text("")
    (checkout.folder / ".gitignore").write_text("hidden.py\n")
    exclude = checkout.folder / ".git/info/exclude"
    exclude.unlink()
    os.mkfifo(exclude)
    command = ["git", "-C", str(checkout.folder), "ls-files", "--others", "--exclude-standard"]
    with pytest.raises(subprocess.TimeoutExpired):
        subprocess.run(command, capture_output=True, check=False, timeout=1)
    found = read_checkout(checkout.folder)
    assert "hidden.py" not in found.files

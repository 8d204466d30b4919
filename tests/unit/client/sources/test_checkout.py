"""In a git checkout the snapshot of a folder is what git would commit, and no program runs."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox.errors import RepositoryUnavailableError, SnapshotError
from envhub_sandbox.extras.sources import checkout
from envhub_sandbox.hub.local import IGNORED, REPOSITORY, LocalFolder
from envhub_sandbox.hub.snapshot import local
from tests.hub.olah_server import GitRepository

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
PLACES = (
    *("__pycache__/env.cpython-311.pyc", ".cache/a.py", ".venv/b.py", ".tox/c.py", "d.pyc"),
    *("node_modules/e.py", "lib/pyvenv.cfg", "lib/f.py", ".ipynb_checkpoints/g.py"),
    "sub/.DS_Store",
    *(".mypy_cache/h.py", ".pytest_cache/i.py", ".ruff_cache/j.py", ".hg/k.py", ".svn/l.py"),
)
"""Where tools put what they make, and a repository can put what it likes."""


@pytest.fixture
def repository(tmp_path: Path, snapshot_store: Path) -> GitRepository:
    made = GitRepository(tmp_path / "my-env")
    made.commit({"env.py": "1"})
    return made


def files(folder: Path) -> dict[str, str]:
    root = local(folder).root
    return {str(p.relative_to(root)): p.read_text() for p in root.rglob("*") if p.is_file()}


def left_out(folder: Path) -> list[tuple[str, str]]:
    return [tuple(one) for one in LocalFolder.at(folder).left_out()]


def test_what_is_committed_counts_wherever_it_lies(repository: GitRepository) -> None:
    repository.commit(dict.fromkeys(PLACES, "payload"))
    assert files(repository.folder) == {**dict.fromkeys(PLACES, "payload"), "env.py": "1"}
    assert left_out(repository.folder) == []


def test_of_ignored_files_committed_ones_count(repository: GitRepository, tmp_path: Path) -> None:
    """Also what only its user ignores, here; what git was made to add counts all the same. What was
    deleted counts no more, and a worktree, whose ``.git`` is a file, is as good."""
    folder = repository.folder
    repository.commit({"gone.py": ""})
    (folder / "gone.py").unlink()
    (folder / "forced.pyc").write_text("payload")
    repository.git("add", "--force", "forced.pyc")
    (folder / ".gitignore").write_text("*.pyc\n.venv/\n")
    with (folder / ".git/info/exclude").open("a") as file:
        file.write("\nmine.txt\n")
    for name in ("new.py", "a.pyc", "mine.txt", ".venv/lib/x.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("there")
    assert set(files(folder)) == {".gitignore", "env.py", "forced.pyc", "new.py"}
    assert left_out(folder) == [(name, IGNORED) for name in (".venv/", "a.pyc", "mine.txt")]
    with pytest.raises(RepositoryUnavailableError, match=r"is ignored by git.*add --force"):
        local(f"{folder}:a.pyc")
    repository.git("worktree", "add", "--quiet", str(tmp_path / "more"))
    (tmp_path / "more/mine.txt").write_text("")
    (tmp_path / "more/new.py").write_text("")
    assert set(files(tmp_path / "more")) == {"env.py", "gone.py", "new.py"}


def test_an_empty_repository_and_pipes_are_no_error(tmp_path: Path, snapshot_store: Path) -> None:
    folder = GitRepository(tmp_path / "new").folder
    (folder / "env.py").write_text("1")
    os.mkfifo(folder / "pipe")
    (folder / "empty").mkdir()
    assert (files(folder), left_out(folder)) == ({"env.py": "1"}, [])


def test_files_that_git_does_not_look_at_are_named(repository: GitRepository) -> None:
    """A commit has git's own version of them, and of a sparse checkout what is not here."""

    def held_back() -> tuple[str, ...]:
        here = LocalFolder.at(repository.folder).checkout
        return here.held_back

    repository.commit({"a.py": "1", "b.py": "1", "far/c.py": "1", "near/d.py": "1"})
    repository.git("update-index", "--assume-unchanged", "a.py")
    repository.git("update-index", "--skip-worktree", "b.py")
    (repository.folder / "a.py").write_text("2")
    assert held_back() == ("a.py", "b.py")
    assert files(repository.folder)["a.py"] == "2"
    repository.git("update-index", "--no-assume-unchanged", "a.py")
    repository.git("update-index", "--no-skip-worktree", "b.py")
    repository.git("checkout", "a.py")
    repository.git("sparse-checkout", "set", "--cone", "--sparse-index", "near")
    assert held_back() == ("far/c.py",)


def test_a_link_is_a_file_with_its_text(repository: GitRepository) -> None:
    """As the Hub has it: nothing is followed, in the folder or out of it."""
    (repository.folder / "sub").mkdir()
    (repository.folder / "sub/real.py").write_text("x")
    (repository.folder / "real.py").write_text("x")
    targets = ("real.py", "gone.py", "/etc/passwd", "..", "sub", "import os")
    links = {f"link{number}.py": target for number, target in enumerate(targets)}
    for link, target in links.items():
        (repository.folder / link).symlink_to(target)
    assert links.items() <= files(repository.folder).items()
    repository.commit({})
    assert links.items() <= files(repository.folder).items()


@pytest.mark.parametrize(("looks", "programs"), [("true", ["new"]), ("false", ["game", "new"])])
def test_the_index_says_what_is_executable_where_git_looks_at_no_modes(
    repository: GitRepository, looks: str, programs: list[str]
) -> None:
    """As in a checkout on Windows; of a file that git does not know yet, its mode counts."""
    for name in ("game", "new"):
        (repository.folder / name).write_text("#!/bin/sh")
        (repository.folder / name).chmod(0o755)
    repository.git("add", "game")
    (repository.folder / "game").chmod(0o644)
    repository.git("config", "core.fileMode", looks)
    assert [file.path for file in local(repository.folder).files if file.executable] == programs


def test_a_virtual_environment_is_left_out_unless_committed(repository: GitRepository) -> None:
    """Who made one here forgot to have git ignore it; a commit may hold what it likes."""
    (repository.folder / "mine/bin").mkdir(parents=True)
    (repository.folder / "mine/pyvenv.cfg").write_text("")
    (repository.folder / "mine/bin/python").symlink_to(sys.executable)
    assert set(files(repository.folder)) == {"env.py"}
    assert left_out(repository.folder) == [("mine/", "a virtual environment")]
    repository.commit({})
    assert set(files(repository.folder)) == {"env.py", "mine/pyvenv.cfg", "mine/bin/python"}
    repository.git("rm", "--quiet", "--cached", "-r", "mine")
    repository.commit({".gitignore": "mine/\n"})
    assert set(files(repository.folder)) == {".gitignore", "env.py"}


def test_what_lies_behind_a_link_is_not_read(repository: GitRepository, tmp_path: Path) -> None:
    """Also where git's index has files of a folder that is a link now."""
    repository.commit({"data/secret.txt": "public"})
    shutil.rmtree(repository.folder / "data")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/secret.txt").write_text("secret")
    (repository.folder / "data").symlink_to(tmp_path / "outside")
    assert "secret" not in files(repository.folder).values()


def test_a_repository_within_is_a_pointer(repository: GitRepository, tmp_path: Path) -> None:
    """Whether it is a submodule or just lies there: its files are in no commit of this one."""
    inner = GitRepository(tmp_path / "inner")
    inner.commit({"payload.py": ""})
    allow = ("-c", "protocol.file.allow=always")
    repository.git(*allow, "submodule", "--quiet", "add", str(inner.folder), "sub")
    shutil.copytree(inner.folder, repository.folder / "loose")
    assert set(files(repository.folder)) == {".gitmodules", "env.py"}
    assert left_out(repository.folder) == [("loose/", REPOSITORY), ("sub/", REPOSITORY)]


def test_conversions_by_git_are_named(repository: GitRepository) -> None:
    """A file whose bytes here are not those of its commit. LFS has the file itself."""
    rules = "*.py ident\n*.txt working-tree-encoding=UTF-16\n*.bin filter=lfs\n*.sh text eol=lf"
    names = ("a.py", "b.txt", "c.bin", "d.sh", "e.md")
    repository.commit({**dict.fromkeys(names, ""), ".gitattributes": rules})
    here = LocalFolder.at(repository.folder)
    assert list(here.checkout.converted(names)) == [
        ("a.py", "ident=set"),
        ("b.txt", "working-tree-encoding=UTF-16"),
    ]


def test_a_folder_in_a_checkout_is_a_part_of_it(repository: GitRepository) -> None:
    (repository.folder / ".gitignore").write_text("*.log\nbuild/\n")
    for name in ("envs/env.py", "envs/a.log", "build/env.py", "build/b.log"):
        (repository.folder / name).parent.mkdir(exist_ok=True)
        (repository.folder / name).write_text("")
    assert set(files(repository.folder / "envs")) == {"env.py"}
    assert left_out(repository.folder / "envs") == [("a.log", IGNORED)]
    assert set(files(repository.folder / "build")) == {"env.py", "b.log"}


@pytest.mark.parametrize(
    "setting",
    [
        "[extensions]\n\tobjectformat = sha256\n",
        "[extensions]\robjectFormat=sha256\r",
        "[extensions]\nobjectformat = sha\\\n256\n",
        '[extensions]objectformat\t= sha"256" # sha1\n',
        "#" * (1 << 20) + "\n[extensions]\nobjectformat = sha256\n",
    ],
    ids=["git's own", "carriage returns", "continued", "partly quoted", "after a MiB"],
)
def test_with_other_hashes_everything_counts(
    tmp_path: Path, snapshot_store: Path, setting: str
) -> None:
    """No Hub has such ids. With ours, git would read another name in this index, without an error:
    the bytes of the id of ten x where it expects length and name.
    """
    folder = tmp_path / "sha256"
    command = ["git", "-C", folder]
    subprocess.run(["git", "init", "--quiet", "--object-format=sha256", folder], check=True)
    config = folder / ".git/config"
    config.write_bytes(f"[core]\nrepositoryformatversion = 1\n{setting}".encode())
    for name in ("env.py", "forced.pyc", "other.pyc"):
        (folder / name).write_text("x" * 10)
    subprocess.run([*command, "add", "forced.pyc"], check=True)
    (folder / ".gitignore").write_text("*.pyc\n")
    assert subprocess.check_output([*command, "ls-files", "--cached"]) == b"forced.pyc\n"
    assert set(files(folder)) == {".gitignore", "env.py", "forced.pyc", "other.pyc"}
    assert checkout.is_unread(folder)
    config.write_bytes(b"[extensions]\nobjectformat = sha1\r\n")
    assert not set(files(folder)) >= {"forced.pyc", "other.pyc"}


SPOIL = {
    "no index": lambda git: (git / "index").write_bytes(
        b"DIRC\0\0\0\x02" + b"\xff" * 4 + b"x" * 64
    ),
    "a file that points nowhere": lambda git: git.write_text("gitdir: /nowhere\0\n"),
    "an empty folder": lambda git: git.mkdir(),
    "a pipe, which can never be read": lambda git: os.mkfifo(git),
}


@pytest.mark.parametrize("spoil", SPOIL)
def test_where_git_reads_nothing_everything_counts(repository: GitRepository, spoil: str) -> None:
    """What names itself ``.git`` hides nothing."""
    repository.commit({".gitignore": "*.pyc\n"})
    (repository.folder / "a.pyc").write_text("payload")
    assert set(files(repository.folder)) == {".gitignore", "env.py"}
    git = repository.folder / ".git"
    if spoil != "no index":
        shutil.rmtree(git)
    SPOIL[spoil](git)
    assert set(files(repository.folder)) == {".gitignore", "a.pyc", "env.py"}


@pytest.mark.parametrize("found", ["", "."], ids=["none", "the stranger's own"])
def test_without_git_everything_counts(
    repository: GitRepository, monkeypatch: pytest.MonkeyPatch, found: str
) -> None:
    repository.commit({".gitignore": "*.pyc\n"})
    (repository.folder / "a.pyc").write_text("payload")
    program = repository.folder / "git"
    program.write_text("#!/bin/sh\n: > ran\n")  # nothing else is on the PATH
    program.chmod(0o755)
    monkeypatch.chdir(repository.folder)
    monkeypatch.setenv("PATH", found)
    assert set(files(repository.folder)) == {".gitignore", "a.pyc", "env.py", "git"}


def test_the_callers_variables_do_not_lead_elsewhere(
    repository: GitRepository, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hook of git's runs with variables that name its repository and a half-made index."""
    other = GitRepository(tmp_path / "other")
    other.commit({"other.py": ""})
    (repository.folder / "new.py").write_text("")
    for name, text in (
        ("GIT_DIR", str(other.folder / ".git")),
        ("GIT_WORK_TREE", str(other.folder)),
        ("GIT_INDEX_FILE", str(other.folder / ".git/index")),
        ("GIT_PREFIX", "sub/"),
    ):
        monkeypatch.setenv(name, text)
    assert set(files(repository.folder)) == {"env.py", "new.py"}


@pytest.mark.skipif(os.getuid() != 0, reason="needs root")
def test_whose_checkout_it_is_counts(repository: GitRepository) -> None:
    """A container's user may be another than the checkout's; one in /tmp may be anybody's."""
    folder = repository.folder
    repository.commit({".gitignore": "*.pyc\n", "sub/env.py": ""})
    (folder / "sub/a.pyc").write_text("")
    assert set(files(folder / "sub")) == {"env.py"}
    os.chown(folder / ".git", 4711, 4711)
    assert set(files(folder / "sub")) == {"a.pyc", "env.py"}
    os.chown(folder / "sub", 4711, 4711)
    assert set(files(folder / "sub")) == {"env.py"}


@pytest.mark.parametrize("name", [b"caf\xe9.py", b"a\nb.py", b"a\\b.py"])
def test_names_that_the_hub_cannot_have_are_refused(repository: GitRepository, name: bytes) -> None:
    (repository.folder / os.fsdecode(name)).write_text("")
    with pytest.raises(SnapshotError, match="in its name"):
        local(repository.folder)

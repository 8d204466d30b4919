"""A file that is named alone gives its code nothing of its folder that is not its own."""

import shutil
from pathlib import Path

import pytest

from envhub_sandbox.errors import PolicyError, RepositoryUnavailableError
from envhub_sandbox.hub.secrets import looks_secret
from envhub_sandbox.hub.snapshot import local
from tests.hub.olah_server import GitRepository

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")


@pytest.fixture
def folder(tmp_path: Path, snapshot_store: Path) -> Path:
    made = tmp_path / "downloads"
    write(made, "env.py", "tax.pdf", ".env", ".ssh/id_rsa", "other.py", "pictures/a.png")
    return made


def write(folder: Path, *names: str, **texts: str) -> None:
    for name, text in {**dict.fromkeys(names, ""), **texts}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def shown(reference: object) -> set[str]:
    snapshot = local(str(reference))
    found = {p.relative_to(snapshot.root).as_posix() for p in snapshot.root.rglob("*")}
    files = {record.path for record in snapshot.files}
    assert files == {name for name in found if not (snapshot.root / name).is_dir()}
    return files


@pytest.mark.parametrize(
    ("code", "there", "own"),
    [
        ("", "a.py", ""),
        ("import a", "a.py b.py a/data.txt", "a.py"),
        ("def make_env():\n try:\n  import a\n except ImportError: pass", "a.py", "a.py"),
        ("from . import a", "a.py b.py __init__.py", "a.py __init__.py"),
        ("from .a import b", "a.py b.py", "a.py"),
        ("from a import b", "a/b.py a/c.py a/data.txt", "a/b.py"),
        ("import a.b.c", "a/b/c.py a/b/d.py", "a/b/c.py"),
        ("import a.b", "a/b/__init__.py a/b/x.xml a/y.xml", "a/b/__init__.py a/b/x.xml"),
        ("import a.b", "a/__init__.py a/b.py a/x/y.xml", "a/__init__.py a/b.py a/x/y.xml"),
        ("from importlib import import_module as i\ni('a.b')", "a/b.py", "a/b.py"),
        ("r(entry_point='a.b:C')", "a/b.py a/c.py", "a/b.py"),
        ("import a", "src/a/__init__.py src/a/x.csv src/b.py", "src/a/__init__.py src/a/x.csv"),
        ("import a", "a.cpython-312-darwin.so a.txt b.so", "a.cpython-312-darwin.so"),
        ("import numpy", "numpy.txt numpy/x.txt", ""),
        ("import a", "a/__init__.py a/.env a/.git/config a/k.pem", "a/__init__.py"),
        ("import importlib\nimportlib.import_module('/etc/a\\0')", "a.py etc/a.py", ""),
    ],
)
def test_its_modules_are_its_own(folder: Path, code: str, there: str, own: str) -> None:
    write(folder, *there.split(), **{"env.py": code})
    assert shown(folder / "env.py") == {"env.py", *own.split()}


def test_imports_are_followed(folder: Path) -> None:
    texts = {"env.py": "import a", "a.py": "from p.q import r", "p/q.py": "import c, a"}
    write(folder, "p/__init__.py", "p/data.bin", "c/d.py", "c/__init__.py", "z.py", **texts)
    own = {"p/__init__.py", "p/data.bin", "c/__init__.py", "c/d.py"}
    assert shown(folder / "env.py") == own | texts.keys()


@pytest.mark.parametrize("target", ["tax.pdf", "../secret.py", "."])
def test_no_link_is_followed(folder: Path, target: str) -> None:
    """Who packed the file may have packed links to what lies beside it."""
    write(folder, "a/__init__.py", **{"env.py": "import a, b", "../secret.py": "secret"})
    (folder / "b.py").symlink_to(target)
    (folder / "a/b.txt").symlink_to(f"../{target}")
    (folder / "c").symlink_to("pictures")
    assert shown(folder / "env.py") == {"env.py", "a/__init__.py"}


@needs_git
def test_what_git_tracks_beside_it_is_shown(tmp_path: Path, snapshot_store: Path) -> None:
    """As it is now; what it imports, too, unless git ignores it; nothing else, and no keys."""
    repository = GitRepository(tmp_path / "checkout")
    repository.commit({"env.py": "import new, old", "data.xml": "1", ".gitignore": "old.py\n"})
    repository.commit({"server.pem": "", "sub/x.txt": ""})
    write(repository.folder, "new.py", "old.py", "tax.pdf", "sub/y.txt", **{"data.xml": "2"})
    expected = {"env.py", "new.py", "data.xml", ".gitignore", "sub/x.txt"}
    assert shown(repository.folder / "env.py") == expected
    assert (local(repository.folder / "env.py").root / "data.xml").read_text() == "2"


@needs_git
def test_what_git_tracks_of_a_home_is_not_shown(
    tmp_path: Path, snapshot_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some keep their home in git; what lies there is no file's repository."""
    repository = GitRepository(tmp_path / "home")
    repository.commit({"env.py": "import a", "a.py": "", ".bashrc": "", "notes/x.txt": ""})
    monkeypatch.setenv("HOME", str(repository.folder))
    assert shown(repository.folder / "env.py") == {"env.py", "a.py"}


def test_who_has_no_home_is_refused_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container may run as a user that it does not know."""
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    monkeypatch.chdir(folder)
    for name in (".env", ".ssh/id_rsa"):
        (folder / name).unlink()
    assert "tax.pdf" in shown(folder)


@pytest.mark.parametrize(
    "name",
    [
        ".env",
        "a/.ssh/config",
        ".netrc",
        "certs/server.PEM",
        "id_rsa",
        "id_work",
        "deploy_rsa",
        ".kube/config",
    ],
)
def test_a_folder_with_keys_is_refused(folder: Path, name: str) -> None:
    shutil.rmtree(folder)
    write(folder, "env.py", name)
    with pytest.raises(PolicyError, match=rf"keys or passwords: {name}\..*allow_secrets=True"):
        local(folder)
    kept = local(folder, allow_secrets=True)
    assert {one.path for one in kept.files} == {"env.py", name}
    assert shown(folder / "env.py") == {"env.py"}


@needs_git
def test_of_a_checkout_counts_what_git_would_commit(tmp_path: Path, snapshot_store: Path) -> None:
    repository = GitRepository(tmp_path / "checkout")
    repository.commit({"env.py": "", ".gitignore": ".env\n"})
    write(repository.folder, ".env")
    assert shown(repository.folder) == {"env.py", ".gitignore"}
    repository.git("add", "--force", ".env")
    with pytest.raises(PolicyError, match=r"passwords: \.env\..*have git ignore it"):
        local(repository.folder)


@pytest.mark.parametrize(
    "name",
    [
        "cacert.pem",
        "id_map.py",
        "id_rsa.pub",
        ".env.example",
        "environment.env",
        "model.keys",
        "env.key.py",
    ],
)
def test_other_names_are_no_keys(name: str) -> None:
    assert not looks_secret(name)


@pytest.mark.parametrize("up", [".", "..", "/"])
def test_a_home_folder_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch, up: str) -> None:
    """So is a folder with it in it; a file there, or a folder below, is none."""
    monkeypatch.setenv("HOME", str(folder))
    with pytest.raises(PolicyError, match=r"is a home directory.*allow_secrets=True"):
        local(folder / up)
    assert shown(folder / "env.py") == {"env.py"}
    assert shown(f"{folder / 'pictures'}/../other.py") == {"other.py"}
    write(folder / "pictures", "env.py")
    assert "a.png" in shown(folder / "pictures")


def test_requirements_that_do_not_count_are_said(folder: Path) -> None:
    """Other versions may give other results; what the folder says counts for the folder."""
    write(folder, "requirements.txt")
    shutil.rmtree(folder / ".ssh")
    (folder / ".env").unlink()
    with pytest.warns(UserWarning, match=rf"requirements.txt does not say .* '{folder}:env.py'"):
        assert shown(folder / "env.py") == {"env.py"}
    assert "requirements.txt" in shown(f"{folder}:env.py")


def test_one_line_says_what_the_code_sees(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(folder, "a.py", **{"env.py": "import a"})
    with caplog.at_level("INFO", "envhub_sandbox.snapshot"):
        local(folder / "env.py")
        local(folder, allow_secrets=True)
    assert caplog.messages == [
        f"local file {folder}/env.py: the code sees 2 files of its folder: a.py, env.py",
        f"local folder {folder}: the code sees 7 files of it",
    ]


MISTYPED = {
    r"no such folder or file here.*Did you mean '.*/env\.py'": lambda folder: f"{folder}/evn.py",
    r"Name the entry file after a colon, as in ':env\.py'": lambda folder: f"{folder}:evn.py",
    r"has no file 'env\.py'.*as in ':gym_env\.py'": lambda folder: (
        f"{(folder / 'env.py').rename(folder / 'gym_env.py').parent}"
    ),
}


@pytest.mark.parametrize("said", MISTYPED)
def test_a_typo_is_answered_with_what_is_there(folder: Path, said: str) -> None:
    for name in (".env", ".ssh", "other.py"):
        shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()
    with pytest.raises(RepositoryUnavailableError, match=said):
        local(MISTYPED[said](folder))

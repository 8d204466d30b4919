"""Local folders become snapshots, so that authors can try before they push."""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors
from envhub_sandbox.hub import local as module
from envhub_sandbox.hub.local import LeftOut, split_local
from envhub_sandbox.hub.snapshot import Snapshot, SnapshotLimits, is_here, local, snapshot_named
from tests.support.interpreter import needs


@pytest.fixture
def folder(tmp_path: Path, snapshot_store: Path) -> Path:
    folder = tmp_path / "my-env"
    (folder / "sub").mkdir(parents=True)
    (folder / "env.py").write_text("1")
    (folder / "sub" / "other.py").write_text("2")
    return folder


def names(snapshot: Snapshot) -> list[str]:
    found = [p for p in snapshot.root.rglob("*") if not p.is_dir()]
    return sorted(str(path.relative_to(snapshot.root)) for path in found)


def test_folder_becomes_a_read_only_copy(folder: Path) -> None:
    snapshot = local(folder)
    assert (snapshot.repo_id, snapshot.repo_type) == (str(folder), "local")
    assert snapshot.path == "env.py"
    assert names(snapshot) == ["env.py", "sub/other.py"] == [f.path for f in snapshot.files]
    (folder / "env.py").write_text("edited")
    assert (snapshot.root / "env.py").read_text() == "1"
    assert folder not in snapshot.root.parents


def test_unchanged_content_is_the_same_snapshot(folder: Path) -> None:
    first = local(folder)
    os.utime(folder / "env.py", (0, 0))
    assert local(folder) == first
    (folder.parent / "alias").symlink_to(folder)
    shutil.copytree(folder, folder.parent / "twin")
    assert local(folder.parent / "alias").root == local(folder.parent / "twin").root == first.root
    (folder / "env.py").write_text("3")
    second = local(folder)
    assert second.commit != first.commit
    assert second.commit.startswith("local-")
    (folder / "env.py").rename(folder / "renamed.py")
    assert local(f"{folder}:renamed.py").commit not in (first.commit, second.commit)


@pytest.mark.parametrize(
    ("text", "path"),
    [
        *(("{}", "env.py"), ("{}/", "env.py"), ("{}/env.py", "env.py"), ("./my-env", "env.py")),
        *(("my-env/env.py", "env.py"), ("~/my-env", "env.py")),
        *(
            (f"{one}:{two}sub/other.py", "sub/other.py")
            for one in ("{}", "./my-env")
            for two in ("", "./")
        ),
    ],
)
def test_local_forms(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str, path: str) -> None:
    monkeypatch.chdir(folder.parent)
    monkeypatch.setenv("HOME", str(folder.parent))
    snapshot = local(text.format(folder))
    assert (snapshot.path, snapshot.repo_id) == (path, str(folder))
    is_file = text.endswith("/env.py")
    assert snapshot.reference == f"{folder}{'/' if is_file else ':'}{path}"
    assert local(snapshot.reference) == snapshot


@pytest.mark.parametrize(
    "text", ["org/repo", "org/repo/", "org", "org:repo/env.py", "org/repo:env.py"]
)
def test_a_folder_that_is_here_comes_before_the_hub(
    tmp_path: Path, snapshot_store: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """With a warning that names both, where the Hub could have it; a revision is the Hub's."""
    monkeypatch.chdir(tmp_path)
    for name in ("org/repo/env.py", "org/env.py", "pypi/env.py", "github/env.py"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        snapshot = snapshot_named(text)
    folder, _, path = text.rstrip("/").partition(":")
    assert snapshot.reference == f"{tmp_path / folder}:{path or 'env.py'}"
    told = [str(one.message) for one in caught]
    assert all(one.filename == __file__ for one in caught), "the line of the caller"
    if folder == "org/repo" and not text.endswith("/"):
        assert told == [
            f"{text!r} is a folder here, and is taken as that. Write './{text}' to say so, or "
            "'org/repo@main' for the repository of that name on the Hub"
        ]
    else:
        assert told == []
    with pytest.raises(errors.RepositoryUnavailableError, match=r"Did you mean '.*/org/env\.py'\?"):
        snapshot_named("org/evn.py")
    others = ("org/repo@main", "pypi:x#y", "github:a/b:env.py", "https://x/org/env.py", "no/repo")
    assert not any(map(is_here, others))


@pytest.mark.parametrize("path", ["envs.py", "../my-env/env.py", "/etc/passwd", "sub"])
def test_missing_entry_lists_the_python_files(folder: Path, path: str) -> None:
    with pytest.raises(
        errors.RepositoryUnavailableError, match=r"it has 'env\.py', 'sub/other\.py'"
    ):
        local(f"{folder}:{path}")
    with pytest.raises(errors.RepositoryUnavailableError, match=r"no such folder.*'\./folder'"):
        local(folder.parent / "my-enf")


def test_every_file_counts_but_those_of_git(folder: Path) -> None:
    """Without git nothing says which files are caches. Sockets and pipes are no files."""
    hidden = {"__pycache__/env.pyc", ".venv/x", "lib/pyvenv.cfg", "sub/.pytest_cache/x", "a.pyc"}
    (folder / ".gitignore").write_text("*")
    for name in (*hidden, "sub/.git/config"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("")
    (folder / ".git").write_text("gitdir: sub")
    os.mkfifo(folder / "pipe")
    descriptor = os.open(folder, os.O_PATH)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"/proc/self/fd/{descriptor}/socket")  # a socket's path has 108 bytes
        os.close(descriptor)
        assert set(names(local(folder))) == hidden | {".gitignore", "env.py", "sub/other.py"}


def test_a_virtualenv_is_left_out_and_said(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Its interpreter is a link, which no file of the Hub is: nobody hides a folder by this."""
    (folder / ".venv/bin").mkdir(parents=True)
    (folder / ".venv/pyvenv.cfg").write_text("")
    (folder / ".venv/bin/python").write_text("")
    assert ".venv/pyvenv.cfg" in names(local(folder))
    (folder / ".venv/bin/python").unlink()
    (folder / ".venv/bin/python").symlink_to(sys.executable)
    with caplog.at_level("INFO", "envhub_sandbox.snapshot"):
        assert names(local(folder)) == ["env.py", "sub/other.py"]
    said = f"local folder {folder}: the code sees 2 files of it; left out: "
    assert caplog.messages == [f"{said}.venv/ (a virtual environment)"]
    with pytest.raises(
        errors.RepositoryUnavailableError, match=r"'.venv/bin/x.py', but left it out"
    ):
        local(f"{folder}:.venv/bin/x.py")


@pytest.fixture
def open_ground() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


_LISTS = """
import sys
from envhub_sandbox.hub.local import LeftOut, split_local
for reference in sys.argv[1:]:
    _, listing = split_local(reference).listed()
    print([one.path for one in listing.files], listing.left_out)
"""


@needs("no-userns")  # what it starts is another user's
def test_what_cannot_be_read_is_left_out_and_said(open_ground: Path) -> None:
    for name, mode in {"env.py": 0o644, "a.txt": 0, "b/x.txt": 0o644, "c.py": 0o644}.items():
        (open_ground / name).parent.mkdir(exist_ok=True)
        (open_ground / name).write_text("import c")
        (open_ground / name).chmod(mode)
    (open_ground / "b").chmod(0o600)  # its names can be read, and nothing else of it
    (open_ground / "d").mkdir(mode=0)
    other: dict[str, Any] = {"user": 65534, "group": 65534} if os.geteuid() == 0 else {}
    command = [sys.executable, "-c", _LISTS, str(open_ground), str(open_ground / "env.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd="/", **other)
    assert done.stderr == ""
    left = [LeftOut(path, "unreadable") for path in ("a.txt", "b/", "d/")]
    assert done.stdout == f"['c.py', 'env.py'] {tuple(left)}\n['c.py', 'env.py'] ()\n"


def test_link_inside_becomes_a_real_file(folder: Path) -> None:
    (folder / "link.py").symlink_to("sub/other.py")
    (folder / "linked").symlink_to("sub")
    snapshot = local(folder)
    assert names(snapshot) == ["env.py", "link.py", "linked/other.py", "sub/other.py"]
    assert not any(path.is_symlink() for path in snapshot.root.rglob("*"))
    assert (snapshot.root / "link.py").read_text() == "2"


def test_programs_stay_programs(folder: Path) -> None:
    """Their bit is a part of the content, and comes back where somebody takes it from the copy."""
    plain = local(folder)
    (folder / "sub/other.py").chmod(0o755)
    snapshot = local(folder)
    assert [one.executable for one in snapshot.files] == [False, True]
    assert snapshot.commit != plain.commit
    program = snapshot.root / "sub/other.py"
    assert [path.stat().st_mode & 0o777 for path in (snapshot.root / "env.py", program)] == [
        0o444,
        0o555,
    ]
    program.chmod(0o444)
    assert local(folder) == snapshot
    assert program.stat().st_mode & 0o777 == 0o555


@pytest.mark.parametrize("target", ["/etc/passwd", "../secret", "/etc", "..", ".git/config"])
def test_link_that_leaves_the_folder_is_refused(folder: Path, target: str) -> None:
    """Nothing outside the folder is copied in through a link, nor what may hold a login."""
    (folder.parent / "secret").write_text("s")
    (folder / ".git").mkdir()
    (folder / ".git/config").write_text("s")
    (folder / "link").symlink_to(target)
    with pytest.raises(errors.SnapshotError, match="'link' points outside the folder"):
        local(folder)


@pytest.mark.parametrize("target", ["gone", "somebody@host.4711", "/gone", "link"])
def test_a_link_to_nothing_is_left_out_and_said(folder: Path, target: str) -> None:
    (folder / "sub" / "link").symlink_to(target)
    here, listing = split_local(str(folder)).listed()
    assert listing.left_out == (("sub/link", "a link to nothing"),)
    assert here.seen(listing).endswith("2 files of it; left out: sub/link (a link to nothing)")


@pytest.mark.parametrize(("target", "said"), [(".", "loop"), ("../sub", "loop"), ("..", "loop")])
def test_link_without_an_end_is_named(folder: Path, target: str, said: str) -> None:
    (folder / "sub" / "link").symlink_to(target)
    with pytest.raises(errors.SnapshotError, match=said):
        local(folder)


def test_bottomless_folder_is_refused(folder: Path) -> None:
    folder.joinpath(*["d"] * 80).mkdir(parents=True)
    with pytest.raises(errors.SnapshotError, match="is over 64 folders deep"):
        local(folder)


@pytest.mark.parametrize("name", ["max_files", "max_bytes", "max_file_bytes"])
def test_large_folder_is_refused(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home folder that was given by mistake is not copied; the error says what counts."""
    (folder / "env.py").write_text("22")
    monkeypatch.setattr(module, "DEFAULT_LIMITS", SnapshotLimits(**{name: 1}))
    with pytest.raises(
        errors.SnapshotTooLargeError, match=rf"{name}(.|\n)*every file in it is included"
    ):
        local(folder)


def test_edited_copy_is_refused_and_half_of_one_made_again(folder: Path) -> None:
    snapshot = local(folder)
    entry = snapshot.root / "env.py"
    snapshot.root.chmod(0o755)
    entry.unlink()
    assert local(folder) == snapshot
    assert entry.read_text() == "1"
    entry.chmod(0o644)
    entry.write_text("x")
    with pytest.raises(errors.SnapshotIntegrityError, match="was changed"):
        local(folder)


def test_forgotten_copies_are_removed_with_the_next_new_one(folder: Path) -> None:
    """Each edit makes a copy: those that nobody used for weeks do not pile up."""
    old = local(folder)
    os.utime(old.root.parent / "record.json", (0, 0))
    (folder / "env.py").write_text("2")
    new = local(folder)
    assert not old.root.exists()
    assert new.root.exists()


def test_an_example_is_found_from_anywhere(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wheel brings them; in a checkout they are those of the checkout."""
    monkeypatch.chdir(tmp_path)
    for name in ("cartpole", "catch", "two_tasks"):
        folder, entry, _ = split_local(f"examples:{name}")
        assert (folder / entry).read_bytes() == (checkout / "examples" / name / entry).read_bytes()


@pytest.mark.parametrize("name", ["", "nope", "../tests", "cartpole/env.py", "ci"])
def test_what_is_no_example_is_refused_with_those_that_there_are(name: str) -> None:
    with pytest.raises(errors.RepositoryUnavailableError, match="choose one: examples:cartpole, "):
        split_local(f"examples:{name}")

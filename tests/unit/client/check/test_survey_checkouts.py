"""Where a folder is not what its commit is, that is found, and fails."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from envhub_sandbox.check.checks import Severity
from envhub_sandbox.check.findings import Finding
from envhub_sandbox.check.static import survey
from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.hub.git import checkout
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.hub.sources import parsing
from tests.hub.olah_server import GitRepository

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
_FILES = {"env.py": "def make_env(): pass", "README.md": "# x", "LICENSE": "MIT"}


@pytest.fixture
def repository(tmp_path: Path, snapshot_store: Path) -> GitRepository:
    made = GitRepository(tmp_path / "my-env")
    made.commit(_FILES)
    return made


def found(folder: Path) -> list[Finding]:
    """What is found where a folder is read."""
    snapshot = local(folder)
    return survey(snapshot, parsing.read(snapshot)).findings


def failing(folder: Path) -> set[str]:
    """The files that fail, all by one check."""
    reported = [one for one in found(folder) if one.check.severity is Severity.ERROR]
    assert {one.id for one in reported} <= {"source-uncommitted"}
    return {one.file for one in reported}


def test_an_honest_checkout_has_no_findings(repository: GitRepository) -> None:
    assert found(repository.folder) == []
    (repository.folder / "new.py").write_text("x = 1\n")
    (repository.folder / "LICENSE").write_text("MIT-0")
    assert found(repository.folder) == []


def test_what_git_ignores_is_a_note(repository: GitRepository) -> None:
    """One for all of it: it is in no commit, in no jail, and nowhere on the Hub."""
    repository.commit({".gitignore": "*.pyc\n.venv/\n"})
    for number in range(12):
        (repository.folder / f"{number:02}.pyc").write_text("")
    (repository.folder / ".venv").mkdir()
    (repository.folder / ".venv/x.py").write_text("")
    [one] = found(repository.folder)
    assert (one.id, one.file) == ("source-ignored", "")
    assert one.message.startswith("git leaves out .venv/, 00.pyc, 01.pyc")
    assert one.message.endswith("08.pyc, 3 more")


def cloned_as_it_is(repository: GitRepository, folder: Path, name: str, text: str) -> Path:
    """A clone of the repository with a file that no filter of git's has changed."""
    (folder / "raw").write_text(text, newline="")
    blob = repository.git("hash-object", "-w", "--no-filters", str(folder / "raw"))
    repository.git("update-index", "--add", "--cacheinfo", f"100644,{blob},{name}")
    repository.git("commit", "--quiet", "--message", "as it is")
    repository.git("clone", "--quiet", str(repository.folder), str(folder / "clone"))
    return folder / "clone"


def test_what_a_checkout_turns_into_a_comment_is_reported(
    repository: GitRepository, tmp_path: Path
) -> None:
    """Git writes the id of a file into it, over what stood there: in the commit that is code."""
    code = "#$Id:\rimport\tos\ros.popen('true')\r$\n"
    repository.commit({"odd.py": code, ".gitattributes": "*.py ident\n"})
    clone = cloned_as_it_is(repository, tmp_path, "odd.py", code)
    assert "popen" in repository.git("cat-file", "blob", "HEAD:odd.py")
    assert "popen" not in (clone / "odd.py").read_text()
    assert failing(clone) == {"env.py", "odd.py"}


def test_what_is_encoded_anew_is_reported(repository: GitRepository, tmp_path: Path) -> None:
    """In the commit the text ends before the code, in the checkout behind it."""
    code = "x = '\u00a5'; import os #\\'\n"
    attributes = "odd.py working-tree-encoding=SHIFT_JIS\n"
    repository.commit({".gitattributes": attributes, "odd.py": code.encode("shift_jis")})
    assert repository.git("cat-file", "blob", "HEAD:odd.py") != code
    assert failing(repository.folder) == {"odd.py"}


def test_attributes_cannot_hide_themselves(repository: GitRepository, tmp_path: Path) -> None:
    """Git makes a folder by those of the commit, of which the folder then has another text."""
    repository.commit({"odd.py": "# $Id$\n"})
    attributes = ".gitattributes working-tree-encoding=UTF-16\n*.py ident\n"
    clone = cloned_as_it_is(repository, tmp_path, ".gitattributes", attributes)
    assert b"ident" not in (clone / ".gitattributes").read_bytes()
    assert (clone / "odd.py").read_text() != "# $Id$\n"
    assert failing(clone) == {".gitattributes", "env.py", "odd.py"}


def test_attributes_that_cannot_be_read_are_an_error(
    repository: GitRepository, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pattern can take git for ever, and what it says then is not known."""
    (repository.folder / ("a" * 200 + "1")).write_text("")
    (repository.folder / ".gitattributes").write_text(f"{'*a' * 60}b ident\n")
    monkeypatch.setattr(checkout, "TIMEOUT_S", 1.0)
    with pytest.raises(SnapshotError, match=r"cannot read its \.gitattributes"):
        found(repository.folder)


def test_a_pointer_in_place_of_a_file_is_reported(repository: GitRepository) -> None:
    """The Hub has the file itself, which was not here to be judged."""
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 9\n"
    repository.commit({"helper.py": pointer, "mesh.stl": f"\n{pointer}"})
    assert failing(repository.folder) == {"helper.py", "mesh.stl"}
    shutil.rmtree(repository.folder / ".git")
    assert failing(repository.folder) == {"helper.py", "mesh.stl"}, "also outside of git"


def test_what_git_does_not_look_at_is_reported(repository: GitRepository, tmp_path: Path) -> None:
    """Repositories within it, and files that it keeps as they were."""
    shutil.copytree(repository.folder, repository.folder / "inner")
    repository.git("update-index", "--assume-unchanged", "LICENSE")
    assert failing(repository.folder) == {"inner/", "LICENSE"}


def test_a_link_is_read_as_the_hub_has_it(repository: GitRepository) -> None:
    (repository.folder / "import os # helper.py").write_text("x = 1\n")
    (repository.folder / "helper.py").symlink_to("import os # helper.py")
    (repository.folder / "other.py").symlink_to("import ctypes")
    reported = {(one.id, one.file) for one in found(repository.folder)}
    assert reported == {("source-link", "helper.py"), ("source-native", "other.py")}

"""Where a folder is not what its commit is, that is found, and fails."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.findings import Finding
from envhub_sandbox.extras.judge.static import static
from envhub_sandbox.extras.sources import checkout
from envhub_sandbox.hub.snapshot import local
from tests.hub.olah_server import GitRepository

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
_FILES = {"env.py": "def make_env(): pass", "README.md": "# x", "LICENSE": "MIT"}


@pytest.fixture
def repository(tmp_path: Path, snapshot_store: Path) -> GitRepository:
    made = GitRepository(tmp_path / "my-env")
    made.commit(_FILES)
    return made


def found(folder: Path) -> list[Finding]:
    return static(local(folder)).findings


def failing(folder: Path) -> set[str]:
    reported = [one for one in found(folder) if one.check.severity is Severity.ERROR]
    assert {one.id for one in reported} <= {"source-uncommitted"}
    return {one.file for one in reported}


def test_an_honest_checkout_has_no_findings(repository: GitRepository) -> None:
    assert found(repository.folder) == []
    (repository.folder / "new.py").write_text("x = 1\n")
    (repository.folder / "LICENSE").write_text("MIT-0")
    assert found(repository.folder) == []


@pytest.mark.parametrize(
    "why", ["not installed", "fails", "SHA-256", "SHA-256, late", "no checkout"]
)
def test_where_git_says_nothing_that_is_found(
    why: str, repository: GitRepository, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As nobody knows what its commit has; a folder in no checkout, the last, is the control."""
    if why == "fails":
        (repository.folder / ".git/index").write_text("none")
    elif why.startswith("SHA-256"):
        text = "[extensions]\nobjectFormat = sha256\n"
        if why.endswith("late"):
            text = "\n" * 60_000 + text.replace("\n", " ")
        with (repository.folder / ".git/config").open("a") as config:
            config.write(text)
    else:
        monkeypatch.setenv("PATH", "")
    if why == "no checkout":
        shutil.rmtree(repository.folder / ".git")
    ids = [one.id for one in found(repository.folder)]
    assert ids == ([] if why == "no checkout" else ["source-uncommitted"])


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
    assert one.message.endswith("08.pyc, and 3 more")


def cloned_as_it_is(repository: GitRepository, folder: Path, name: str, text: str) -> Path:
    (folder / "raw").write_text(text, newline="")
    blob = repository.git("hash-object", "-w", "--no-filters", str(folder / "raw"))
    repository.git("update-index", "--add", "--cacheinfo", f"100644,{blob},{name}")
    repository.git("commit", "--quiet", "--message", "as it is")
    repository.git("clone", "--quiet", str(repository.folder), str(folder / "clone"))
    return folder / "clone"


def test_what_becomes_a_comment_is_reported(repository: GitRepository, tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("name", "rest"), [(".gitattributes", " ident"), (".gitignore", "")], ids=["convert", "ignore"]
)
def test_patterns_that_cannot_be_read_are_an_error(
    repository: GitRepository, monkeypatch: pytest.MonkeyPatch, name: str, rest: str
) -> None:
    """One can take git for ever, and what it says then is not known: which files it converts."""
    (repository.folder / ("a" * 200 + "1")).write_text("")
    (repository.folder / name).write_text(f"{'*a' * 60}b{rest}\n")
    monkeypatch.setattr(checkout, "TIMEOUT_S", 0.4)
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
    shutil.copytree(repository.folder, repository.folder / "inner")
    repository.git("update-index", "--assume-unchanged", "LICENSE")
    assert failing(repository.folder) == {"inner/", "LICENSE"}


def test_a_link_is_read_as_the_hub_has_it(repository: GitRepository) -> None:
    (repository.folder / "import os # helper.py").write_text("x = 1\n")
    (repository.folder / "helper.py").symlink_to("import os # helper.py")
    (repository.folder / "other.py").symlink_to("import ctypes")
    reported = {(one.id, one.file) for one in found(repository.folder)}
    assert reported == {("source-link", "helper.py"), ("source-native", "other.py")}


# --- Whatever a commit holds: a clone of it is judged as the Hub would have it, or fails by name


_COMMITTER = "author A <a@b> 0 +0000\ncommitter A <a@b> 0 +0000\n"
_FOLDERS = st.sampled_from(
    ("", "", "lib/", ".venv/", "__pycache__/", ".cache/x/", "node_modules/", "a/b/c/", ".GitHub/")
)
_LEAVES = st.sampled_from(
    (
        *("a.py", "b.py", "c.pyc", "d.txt", "pyvenv.cfg", ".gitignore", ".gitattributes", "-e.py"),
        *("f g.py", ".gitmodules", ".DS_Store", "\u00e9.py", "e\u0301.py", "A.py", "[a].py"),
        "*.py",
    )
)
_PATHS = st.builds(str.__add__, _FOLDERS, _LEAVES)
_RULES = st.sampled_from(
    (
        *("*", "*.py", "!*.py", "__pycache__/", ".venv", "/lib/", "**/*.pyc", ".git*", "a.py"),
        *("*.py ident", "*.py -ident", "*.py working-tree-encoding=UTF-16", "*.py eol=crlf"),
        *("* text=auto eol=crlf", "*.py filter=lfs", "*.txt filter=mine", "[attr]x ident"),
        *("*.py x", "\\*.py"),
        *(".gitattributes working-tree-encoding=UTF-16", ".gitattributes ident", "*.py binary"),
        *("*.py working-tree-encoding=SHIFT_JIS", "*.py text", "*.py !ident", "*.py export-ignore"),
    )
)
_CONTENTS = st.one_of(
    st.lists(_RULES, max_size=4).map(lambda rules: "".join(f"{one}\n" for one in rules).encode()),
    st.sampled_from(
        (
            *(b"", b"x = 1\n", b"x\r\ny\n", b"x\ry", b"$Id$\n", b"# $Id:\rimport\tos\r$\n"),
            *("x = '\u00a5'\n".encode(), "\u5f3a".encode(), b"\xff\xfe\0", b"\xef\xbb\xbfx"),
            b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        )
    ),
)
_TARGETS = st.sampled_from(("a.py", "lib", "..", "/etc/passwd", "gone", "lib/a.py", ".git/config"))
_ENTRIES = st.one_of(
    st.tuples(st.just("100644"), _CONTENTS),
    st.tuples(st.just("100755"), _CONTENTS),
    st.tuples(st.just("120000"), _TARGETS.map(str.encode)),
)
_COMMITS = st.dictionaries(_PATHS, _ENTRIES, max_size=8)
_ENTRY = {"env.py": ("100644", b"def make_env(): pass\n")}


def commit(folder: Path, files: dict[str, tuple[str, bytes]]) -> None:
    subprocess.run(["git", "init", "--quiet", "--initial-branch=main", folder], check=True)
    parts = [b"commit refs/heads/main\n", _COMMITTER.encode(), b"data 0\n"]
    for path, (mode, data) in files.items():
        parts.append(f"M {mode} inline {path}\ndata {len(data)}\n".encode() + data + b"\n")
    given = b"".join(parts)
    subprocess.run(["git", "-C", folder, "fast-import", "--quiet"], input=given, check=True)


def one_kind(files: dict[str, tuple[str, bytes]]) -> dict[str, tuple[str, bytes]]:
    links = [f"{path}/" for path in files]
    return {path: one for path, one in files.items() if not path.startswith(tuple(links))}


@settings(max_examples=settings().max_examples // 6)
@given(_COMMITS)
def test_a_clone_is_judged_as_its_commit_or_fails(files: dict[str, tuple[str, bytes]]) -> None:
    """Each file that the Hub would hand out is there, as it is; or it is reported, and fails."""
    files = {**one_kind(files), **_ENTRY}
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ENVHUB_CACHE", f"{place}/cache")
        commit(Path(place, "origin"), files)
        command = ["git", "clone", "--quiet", f"{place}/origin", f"{place}/clone"]
        if subprocess.run(command, check=False, capture_output=True).returncode:
            return  # git makes no such clone, as where .gitmodules is a link
        snapshot = local(f"{place}/clone")
        found = static(snapshot).findings
        judged = {one.path: (snapshot.root / one.path).read_bytes() for one in snapshot.files}
    failing = {one.file for one in found if one.check.severity is Severity.ERROR}
    lines = {path: data.replace(b"\r\n", b"\n") for path, data in judged.items()}
    for path, (_, data) in files.items():
        assert path in judged or path in failing
        assert lines.get(path) == data.replace(b"\r\n", b"\n") or path in failing
    assert set(judged) <= set(files)

"""Whatever a commit holds: a clone of it is judged as the Hub would have it, or fails by name."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envhub_sandbox.check.checks import Severity
from envhub_sandbox.check.static import survey
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.hub.sources import parsing

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
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
    """Make a commit of exactly these blobs, with nothing in a folder."""
    subprocess.run(["git", "init", "--quiet", "--initial-branch=main", folder], check=True)
    parts = [b"commit refs/heads/main\n", _COMMITTER.encode(), b"data 0\n"]
    for path, (mode, data) in files.items():
        parts.append(f"M {mode} inline {path}\ndata {len(data)}\n".encode() + data + b"\n")
    given = b"".join(parts)
    subprocess.run(["git", "-C", folder, "fast-import", "--quiet"], input=given, check=True)


def one_kind(files: dict[str, tuple[str, bytes]]) -> dict[str, tuple[str, bytes]]:
    """Without files that lie below others."""
    links = [f"{path}/" for path in files]
    return {path: one for path, one in files.items() if not path.startswith(tuple(links))}


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
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
        found = survey(snapshot, parsing.read(snapshot)).findings
        judged = {one.path: (snapshot.root / one.path).read_bytes() for one in snapshot.files}
    failing = {one.file for one in found if one.check.severity is Severity.ERROR}
    lines = {path: data.replace(b"\r\n", b"\n") for path, data in judged.items()}
    for path, (_, data) in files.items():
        assert path in judged or path in failing
        assert lines.get(path) == data.replace(b"\r\n", b"\n") or path in failing
    assert set(judged) <= set(files)

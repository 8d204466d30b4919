"""A host of git, as a host of repositories: what is read of it is held against its names."""

import contextlib
import hashlib
import io
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.errors import SnapshotIntegrityError
from envhub_sandbox.extras.sources import git_commits as commits
from envhub_sandbox.extras.sources.git_commits import GitHost
from envhub_sandbox.hub.listing import FileRecord, Repository

HOST = GitHost("https://git.example")
REPO = Repository("git", "org/repo")
COMMIT = "a" * 40


def blob(path: str, data: bytes) -> commits.GitBlob:
    """A file under the name that git gives its content."""
    digest = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    return commits.GitBlob(path, digest, len(data), executable=False, is_link=False)


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """What the host has, by path; ``!`` before a path: it gives other bytes than it names."""
    files: dict[str, bytes] = {}

    @contextlib.contextmanager
    def fetched(url: str, commit: str) -> Iterator[commits.GitFiles]:
        assert (url, commit) == ("https://git.example/org/repo", COMMIT)
        blobs, content = [], b""
        for name, data in files.items():
            path, lies = name.lstrip("!"), name.startswith("!")
            one = blob(path, data)
            blobs.append(one)
            content += f"{one.digest} blob {one.size}\n".encode()
            content += (data[::-1] if lies else data) + b"\n"
        yield commits.GitFiles(blobs, [f"deps/{i}" for i in range(12)], io.BytesIO(content))

    monkeypatch.setattr(commits, "fetched", fetched)
    return files


def read(tmp_path: Path) -> dict[str, bytes]:
    found = {}
    with HOST.files(REPO, COMMIT) as files:
        records = list(files.listing)
        copy = files.copier(records, "org/repo")
        for number, record in enumerate(reversed(records)):
            copy(record, tmp_path / str(number))
            found[record.path] = (tmp_path / str(number)).read_bytes()
    return found


def test_files_are_read_in_any_order(serve: dict[str, bytes], tmp_path: Path) -> None:
    serve |= {"env.py": b"x = 1\n", "empty": b"", "data/a": b"\0" * 5000}
    assert read(tmp_path) == serve
    with HOST.files(REPO, COMMIT) as files:
        first = next(files.listing)
    assert first == FileRecord("env.py", 6, f"git-sha1:{blob('env.py', serve['env.py']).digest}")


def test_other_bytes_than_those_named_are_refused(serve: dict[str, bytes], tmp_path: Path) -> None:
    serve |= {"env.py": b"good", "!data": b"0123"}
    with pytest.raises(
        SnapshotIntegrityError, match=r"org/repo: git returned .* as 'data', which is"
    ):
        read(tmp_path)


def test_what_is_left_out_is_said(
    serve: dict[str, bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    serve |= {"env.py": b"good", ".gitattributes": b"*.bin filter=lfs\n"}
    with caplog.at_level(logging.WARNING):
        read(tmp_path)
    submodules, lfs = (record.getMessage() for record in caplog.records)
    assert "submodules are left out: 'deps/0'" in submodules
    assert submodules.endswith(" and 2 more")
    assert "in LFS only the pointers are here" in lfs

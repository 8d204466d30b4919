"""Archives that keep their reader: a header that leads back, a download that never ends.
They are read in this process's stead by one that ends at a deadline. The controls read the same as
one does without this project."""

import contextlib
import gzip
import hashlib
import subprocess
import sys
import tarfile
import tracemalloc
from itertools import islice
from pathlib import Path

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages.builds import apart
from tests.attacks.packages.test_git_references import dripping
from tests.support.packages.refusals import refused_dependency
from tests.support.processes import eventually

_BLOCK = 512
_FETCH = "import sys, urllib.request; urllib.request.urlopen(sys.argv[1]).read()"


def header(name: str, size: int) -> bytes:
    member = tarfile.TarInfo(name)
    member.size = size
    return member.tobuf(tarfile.GNU_FORMAT)


def archived(folder: Path, data: bytes) -> Path:
    path = folder / "x-1.0.tar.gz"
    path.write_bytes(gzip.compress(data))
    return path


def fetched(archive: Path) -> Path:
    place = archive.parent / "place"
    (place / "tree").mkdir(parents=True)
    digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    return apart.fetch(archive.as_uri(), digest, place / archive.name, place / "tree", "x 1.0")


def test_a_size_below_zero_leads_nowhere(tmp_path: Path) -> None:
    """The last header leads back to the one before it: a reader that follows never ends.
    An interpreter that has been mended refuses it, too; then there is no control."""
    data = header("x-1.0/a", 0) * 2 + header("x-1.0/b", -2 * _BLOCK)
    archive = archived(tmp_path, data + bytes(2 * _BLOCK))
    with contextlib.suppress(tarfile.TarError), tarfile.open(archive) as opened:
        assert len(list(islice(opened, 1000))) == 1000, "the control failed"
    with refused_dependency("integrity", match=r"x-1\.0/b.*size"):
        fetched(archive)
    assert not list((tmp_path / "place").rglob("b")), "it keeps what it refuses"


def sparse(count: int) -> bytes:
    """An old sparse file whose map goes on in so many blocks."""
    member = tarfile.TarInfo("x-1.0/s")
    member.type = tarfile.GNUTYPE_SPARSE
    block = bytearray(member.tobuf(tarfile.GNU_FORMAT))
    block[482] = 1
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    more = b"%011o\0%011o\0" % (1, 1) * 21
    return bytes(block) + (more + b"\1").ljust(_BLOCK, b"\0") * count + more.ljust(_BLOCK, b"\0")


def test_a_map_that_never_ends_is_not_read(tmp_path: Path) -> None:
    """Of a sparse file: a few kilobytes, packed, of which Python makes a long list."""
    archive = archived(tmp_path, sparse(5_000) + bytes(2 * _BLOCK))
    assert archive.stat().st_size < 50_000
    tracemalloc.start()
    try:
        with tarfile.open(archive) as opened:
            opened.getmembers()
        assert tracemalloc.get_traced_memory()[1] > 5_000_000, "the control failed"
    finally:
        tracemalloc.stop()
    with refused_dependency("integrity", match="only files are unpacked"):
        fetched(archive)


def test_a_download_that_never_ends_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A byte now and then keeps whoever waits for the next one; our process is ended for it."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with dripping() as (url, gone):
        reader = subprocess.Popen([sys.executable, "-c", _FETCH, url])
        assert not gone.wait(5), "the control failed"
        reader.kill()
        reader.wait()
    monkeypatch.setattr(apart, "DEADLINE_S", 5.0)
    with dripping() as (url, gone):
        with pytest.raises(DependencyError, match="took longer than 5 s"):
            apart.fetch(f"{url}/x.tar.gz", "0" * 64, tmp_path / "x", tmp_path / "tree", "x 1.0")
        assert gone.wait(60), "its process lives on"


def test_what_takes_more_memory_than_there_is_ends_its_reader_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever ends it: an error says which source it was, and nothing of it is left."""
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(DependencyError, match=r"x 1\.0: its process ended \(1\)"):
        fetched(archived(tmp_path, b""))
    assert eventually(lambda: not list((tmp_path / "place" / "tree").iterdir()))

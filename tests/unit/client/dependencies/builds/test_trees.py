"""Source archives are unpacked as data: within bounds, without links, and nowhere else."""

import gzip
import io
import os
import stat
import tarfile
import tracemalloc
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages.builds import trees
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.sdists import add, make_sdist


def packed(
    tmp_path: Path, *members: tuple[str, bytes, bytes], name: str = "x-1.0.tar.gz", **options: Any
) -> Path:
    path = tmp_path / name
    with tarfile.open(path, "w:gz", format=tarfile.PAX_FORMAT, **options) as archive:
        for name, data, kind in members:
            add(archive, name, data, kind)
    return path


def unpacked(archive: Path) -> Path:
    folder = archive.parent / "tree"
    folder.mkdir()
    return trees.unpack_tree(archive, folder, "x 1.0")


def test_the_files_of_a_source_distribution(tmp_path: Path) -> None:
    make_sdist(tmp_path, "x", files={"a/b.py": "1", "setup.py": "2"})
    top = unpacked(tmp_path / "x-1.0.tar.gz")
    assert (top.name, (top / "a/b.py").read_text()) == ("x-1.0", "1")
    assert stat.S_IMODE((top / "setup.py").stat().st_mode) == 0o644


def zipped(tmp_path: Path, name: str, mode: int, text: str) -> Path:
    path = tmp_path / "x-1.0.zip"
    with zipfile.ZipFile(path, "w") as archive:
        member = zipfile.ZipInfo(name)
        member.external_attr = mode << 16
        archive.writestr(member, text)
    return path


def test_a_zip_and_what_may_be_executed(tmp_path: Path) -> None:
    """The mode of a file is kept as far as it says that it may be executed; links are refused."""
    found = unpacked(zipped(tmp_path, "x-1.0/configure", 0o104755, "#!/bin/sh")) / "configure"
    assert os.access(found, os.X_OK)
    assert not found.stat().st_mode & 0o4000
    assert stat.S_ISREG(found.stat().st_mode)
    link = zipped(tmp_path, "x-1.0/link", stat.S_IFLNK | 0o777, "/etc/passwd")
    with refused_dependency("integrity", match="link"):
        trees.unpack_tree(link, tmp_path, "x")
    data = bytearray(zipped(tmp_path, "x-1.0/y", 0, "").read_bytes())
    data[6] = data[data.rindex(b"PK\1\2") + 8] = 1
    link.write_bytes(data)
    with refused_dependency("integrity", match="encrypted"):
        trees.unpack_tree(link, tmp_path, "x")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("x/../../out", b"0"),
        ("/tmp/out", b"0"),
        ("x/a\\b", b"0"),
        ("x/" + "d/" * 70 + "f", b"0"),
        ("x/link", tarfile.SYMTYPE),
        ("x/hard", tarfile.LNKTYPE),
        ("x/device", tarfile.CHRTYPE),
        ("x/pipe", tarfile.FIFOTYPE),
    ],
)
def test_what_could_lead_out_is_refused(tmp_path: Path, name: str, kind: bytes) -> None:
    archive = packed(tmp_path, ("x/fine", b"1", b"0"), (name, b"", kind))
    with refused_dependency("integrity"):
        unpacked(archive)
    assert not list((tmp_path / "tree").iterdir())


@pytest.mark.parametrize("names", [("x/a", "x/a"), ("x/a", "y/a"), ("x",)])
def test_more_than_one_of_its_kind(tmp_path: Path, names: tuple[str, ...]) -> None:
    """A name twice: two programs could read two files; two tops, or a file: which is the source?"""
    with refused_dependency("integrity", match=r"twice|[12] entries"):
        unpacked(packed(tmp_path, *((name, b"", b"0") for name in names)))


def test_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = packed(tmp_path, ("x/a", b"1" * 100, b"0"), ("x/b", b"1" * 100, b"0"))
    folders = packed(tmp_path, *((f"x/{n}", b"", b"5") for n in range(8)), name="folders.tar.gz")
    for bound, value, one in (
        *(("MAX_BYTES", 150, archive), ("MAX_FILES", 1, archive), ("MAX_FILES", 1, folders)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(trees, bound, value)
            with refused_dependency("size"):
                trees.unpack_tree(one, tmp_path, "x")


def test_a_stream_is_read_neither_far_nor_much_at_once() -> None:
    """An archive says its own lengths and places; what is compressed is unpacked up to there."""

    class Endless(io.BytesIO):
        at = 0

        def read(self, size: int | None = -1) -> bytes:
            return bytes(size or 0)  # of less than nothing: a ValueError

        def tell(self) -> int:
            return self.at

    source = Endless()
    stream = trees.BoundedStream(source, "x", 10)
    assert len(stream.read(10)) == 10
    for read in (partial(stream.read, 11), stream.read, partial(stream.seek, 1 << 40)):
        with refused_dependency("size"):
            read()
    source.at = 1 << 40
    with refused_dependency("size"):
        stream.read(1)


def test_a_header_that_is_a_bomb(tmp_path: Path) -> None:
    """An extended header has any length, and tarfile reads it at once."""
    member = tarfile.TarInfo("x/a")
    member.type, member.size = tarfile.XHDTYPE, 1 << 32
    path = tmp_path / "x-1.0.tar.gz"
    path.write_bytes(gzip.compress(member.tobuf() + bytes(1024)))
    with refused_dependency("size"):
        unpacked(path)


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_whose_packing_has_no_bounds(tmp_path: Path, packing: int) -> None:
    """Of these Python unpacks all that a block holds, whatever is asked for."""
    path = tmp_path / "x-1.0.zip"
    with zipfile.ZipFile(path, "w", packing) as archive:
        archive.writestr("x-1.0/setup.py", bytes(32 << 20))
    tracemalloc.start()
    try:
        with refused_dependency("integrity", match="not supported"):
            unpacked(path)
        assert tracemalloc.get_traced_memory()[1] < 24 << 20
        with zipfile.ZipFile(path) as archive, archive.open("x-1.0/setup.py") as file:
            file.read(1)
        assert tracemalloc.get_traced_memory()[1] > 24 << 20, "the control failed: it is no bomb"
    finally:
        tracemalloc.stop()


def test_a_zip_whose_files_lie_in_each_other(tmp_path: Path) -> None:
    """Many of them may be packed into the bytes of one."""
    path = tmp_path / "x-1.0.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("a", "b"):
            archive.writestr(f"x-1.0/{name}", b"1" * 100)
    data = bytearray(path.read_bytes())
    offset = data.rindex(b"PK\1\2") + 42
    data[offset : offset + 4] = (50).to_bytes(4, "little")
    path.write_bytes(data)
    with refused_dependency("integrity", match="lies within another"):
        unpacked(path)


def test_headers_for_all_files_are_kept_once(tmp_path: Path) -> None:
    headers = {f"key{number}": "x" * 50 for number in range(450)}
    members = ((f"x-1.0/{number}", b"", tarfile.REGTYPE) for number in range(500))
    path = packed(tmp_path, *members, pax_headers=headers)
    tracemalloc.start()
    try:
        unpacked(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
        with tarfile.open(path) as archive:
            archive.getmembers()
        assert tracemalloc.get_traced_memory()[1] > 4 << 20, "the control failed: it is no bomb"
    finally:
        tracemalloc.stop()


def test_a_file_that_is_not_as_long_as_it_says(tmp_path: Path) -> None:
    for data in (b"12", b"1" * 99):
        member = trees.Member(f"{len(data)}", 3, False, partial(io.BytesIO, data))
        with refused_dependency("integrity", match="size"):
            trees.write_tree([member], tmp_path, "x")
        assert not list(tmp_path.iterdir()), "it writes what it refuses"


@pytest.mark.parametrize("data", [b"", b"no archive", gzip.compress(b"neither", mtime=0)])
def test_what_is_no_archive(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "x-1.0.tar.gz"
    path.write_bytes(data)
    with pytest.raises(DependencyError):
        unpacked(path)
    path = tmp_path / "x-1.0.rar"
    path.write_bytes(data)
    with refused_dependency("integrity", match=r"\.tar\.gz, \.tar\.bz2 and \.zip are read"):
        trees.unpack_tree(path, tmp_path, "x")

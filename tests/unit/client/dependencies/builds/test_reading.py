"""What sources say of their build, what a build lacked, and downloads: all of it is data."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from envhub_sandbox.dependencies.builds import download, project
from envhub_sandbox.errors import (
    IndexUnavailableError,
    PackageIntegrityError,
    PackagesTooLargeError,
    RequirementError,
)
from tests.support.packages.wheels import served

LEGACY = "setuptools.build_meta:__legacy__"


@pytest.mark.parametrize(
    ("text", "requires", "backend"),
    [
        (None, ["setuptools", "wheel"], LEGACY),
        ("[tool.x]\n", ["setuptools", "wheel"], LEGACY),
        ("[build-system]\nrequires = ['cython<4']\n", ["cython<4"], LEGACY),
        ("[build-system]\nrequires = []\nbuild-backend = 'a.b:c'\n", [], "a.b:c"),
    ],
)
def test_how_it_is_built(
    tmp_path: Path, text: str | None, requires: list[str], backend: str
) -> None:
    """As the standards have it: setuptools is what builds where nothing is said."""
    if text is not None:
        (tmp_path / "pyproject.toml").write_text(text)
    found = project.read(tmp_path, "x 1.0")
    assert [str(one.requirement) for one in found.requires] == requires
    assert found.backend == backend
    assert found.uses_setuptools == (backend == LEGACY)


@pytest.mark.parametrize(
    "text",
    [
        "[build-system]\nrequires = ['x @ file:///etc']\n",
        "[build-system]\nrequires = ['--index-url=http://x']\n",
        "[build-system]\nrequires = 3\n",
        "[build-system]\nrequires = []\nbuild-backend = 'a; import os'\n",
        '[build-system]\nrequires = []\nbackend-path = ["a\\nb"]\n',
        "build-system = 3\n",
        "no toml",
        "a" + ".a" * 3000 + " = 1\n",
    ],
)
def test_what_is_not_taken(tmp_path: Path, text: str) -> None:
    (tmp_path / "pyproject.toml").write_text(text)
    with pytest.raises(RequirementError, match=r"x 1\.0"):
        project.read(tmp_path, "x 1.0")


@pytest.mark.parametrize(
    ("log", "said"),
    [
        ("error: command 'gcc' failed: No such file or directory", "apt-get install gcc"),
        ("error: command '/usr/bin/x86_64-linux-gnu-g++' failed: No such file or directory", "g++"),
        ("FileNotFoundError: [Errno 2] No such file or directory: 'cmake'", "install cmake"),
        ("/bin/sh: 1: sdl2-config: not found", "apt-get install libsdl2-dev"),
        ("RuntimeError: CMake must be installed to build", "apt-get install cmake"),
        ("No CMAKE_C_COMPILER could be found.", "apt-get install gcc g++"),
        ("x.c:1:10: fatal error: Python.h: No such file or directory", "python3-dev"),
        ("x.c:1:10: fatal error: foo/bar.h: No such file or directory", "header foo/bar.h"),
        ("/usr/bin/ld: cannot find -lGLEW: No such file", "library GLEW"),
        ("urllib.error.URLError: <urlopen error [Errno -3] Temporary failure", "the network"),
    ],
)
def test_what_was_missing_is_named(log: str, said: str) -> None:
    assert said in project.advice(f"running build_ext\n{log}\n")


def test_nothing_is_guessed() -> None:
    """A file of its own that is missing is no program, and few programs come as wheels."""
    assert project.wheel_for("error: command 'swig' failed: No such file or directory") == "swig<5"
    assert project.wheel_for("error: command 'gcc' failed: No such file or directory") == ""
    assert project.advice("No such file or directory: 'README.md'\nSyntaxError") == ""


def test_downloads_are_bounded_and_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another file than the one that is known is refused, and so is one that is too large."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    shelf, target = tmp_path / "shelf", tmp_path / "target"
    shelf.mkdir()
    (shelf / "x-1.tar.gz").write_bytes(b"data")
    known = hashlib.sha256(b"data").hexdigest()
    with served(shelf) as index:
        url = index.url.replace("/simple", "/files/x-1.tar.gz")
        download.download(url, known, target)
        assert target.read_bytes() == b"data"
        index.replaced["x-1.tar.gz"] = b"tada"
        with pytest.raises(PackageIntegrityError, match="it was replaced"):
            download.download(url, known, target)
        with pytest.raises(IndexUnavailableError, match="404"):
            download.download(url + "x", known, target)
        monkeypatch.setattr(download, "MAX_BYTES", 3)
        with pytest.raises(PackagesTooLargeError):
            download.download(url, known, target)
    for other in ("ftp://127.0.0.1/x", "http://127.0.0.1:1/x", "file:///dev/zero"):
        with pytest.raises(IndexUnavailableError):
            download.download(other, known, target)


def test_a_login_goes_to_the_host_of_its_index_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UV_INDEX", "mine=https://me:secret@index.example/simple")
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    assert download.login_for("https://index.example/x") == ("me", "secret")
    assert download.login_for("https://other.example/x") is None
    with pytest.raises(IndexUnavailableError) as caught:
        download.download("http://me:secret@127.0.0.1:1/x", "", tmp_path / "x")
    assert "secret" not in str(caught.value)

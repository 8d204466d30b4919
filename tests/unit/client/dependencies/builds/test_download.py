"""A commit of git is fetched as data: no hook, filter, submodule, login or other protocol."""

import hashlib
import os
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages.builds import download, project
from envhub_sandbox.extras.sources import git_address as address
from envhub_sandbox.extras.sources import git_commits as commits
from envhub_sandbox.hub.logins import authorization
from tests.support.packages.git_server import commit, git_served, make_repository
from tests.support.packages.git_server import git as run_git
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import served
from tests.support.ports import QuietHandler, serving


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    folder = tmp_path / "served" / "org" / "repo"
    folder.mkdir(parents=True)
    make_repository(folder, {"setup.py": "1", "a/b.py": "2"})
    run_git(folder, "tag", "-a", "v1", "-m", "x")
    (folder / "setup.py").write_text("3")
    commit(folder)
    return folder


@pytest.fixture
def url(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Its address; http is permitted here alone."""
    monkeypatch.setattr(address, "PROTOCOLS", ("http",))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with git_served(tmp_path / "served") as where:
        yield f"{where}/org/repo"


@pytest.fixture
def target(tmp_path: Path) -> Path:
    folder = tmp_path / "target"
    folder.mkdir()
    return folder


def test_the_files_of_a_commit(url: str, repository: Path, target: Path) -> None:
    found = download.resolve(url, "v1")
    assert found == run_git(repository, "rev-parse", "v1^{commit}")
    download.check_out(url, found, target, print)
    files = {str(f.relative_to(target)): f.read_text() for f in target.rglob("*") if f.is_file()}
    assert files == {"setup.py": "1", "a/b.py": "2"}
    newest = run_git(repository, "rev-parse", "main")
    assert download.resolve(url, "main") == download.resolve(url, "HEAD") == newest
    assert download.resolve("https://nowhere.invalid/x", "a" * 40) == "a" * 40


@pytest.mark.parametrize(
    "revision", ["v2", "1234567", "main~1", "--upload-pack=x", "a b", "", "a..b", "a@{0}", "-x"]
)
def test_what_is_not_there_or_an_option(url: str, revision: str) -> None:
    with pytest.raises((DependencyError, DependencyError), match=r"40 digits|not a commit"):
        download.resolve(url, revision)


@pytest.mark.parametrize(
    "url",
    [
        *("ssh://git@h/x", "file:///etc", "http://h/x", "git://h/x", "ext::sh -c x", "/etc"),
        *("https://-x/y", "https://u:p@h/x", "https://h/x y", "https://h/x?a=b", "https://h"),
        "--upload-pack=x",
    ],
)
def test_only_https_without_a_login(url: str, target: Path) -> None:
    with refused_dependency("requirement", match="not a supported address"):
        download.check_out(url, "a" * 40, target, print)


def test_links_and_submodules_are_left_out(url: str, repository: Path, target: Path) -> None:
    (repository / "link").symlink_to("/etc/passwd")
    inner = "0" * 39 + "1"
    run_git(repository, "update-index", "--add", "--cacheinfo", f"160000,{inner},module")
    run_git(repository, "add", "link")
    run_git(repository, "commit", "--quiet", "--message=x")
    said: list[str] = []
    download.check_out(url, run_git(repository, "rev-parse", "HEAD"), target, said.append)
    assert sorted(path.name for path in target.iterdir()) == ["a", "setup.py"]
    assert len(said) == 2
    assert "link is a link or a submodule" in "".join(said)


def test_attributes_do_nothing(url: str, repository: Path, target: Path) -> None:
    (repository / ".gitattributes").write_text("* export-ignore\n*.py filter=x text eol=crlf\n")
    (repository / "setup.py").write_bytes(b"$Format:%H$\n")
    download.check_out(url, commit(repository), target, print)
    assert (target / "setup.py").read_bytes() == b"$Format:%H$\n"


def test_a_name_that_leads_out(url: str, repository: Path, target: Path) -> None:
    blob = run_git(repository, "hash-object", "-w", "setup.py")
    (repository / "tree").write_bytes(b"100644 a\\b\0" + bytes.fromhex(blob))
    tree = run_git(repository, "hash-object", "-w", "-t", "tree", "--literally", "tree")
    bad = run_git(repository, "commit-tree", tree, "-m", "x")
    run_git(repository, "branch", "bad", bad)
    with refused_dependency("integrity", match="backslash"):
        download.check_out(url, bad, target, print)
    assert not list(target.iterdir())


def test_trees_that_hold_each_other(
    url: str, repository: Path, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six objects list 40,000 files: what git prints of them never comes into our memory."""
    monkeypatch.setattr(commits, "MAX_FILES", 2_000)
    kind = f"100644 blob {run_git(repository, 'hash-object', '-w', 'setup.py')}"
    for count in (10, 10, 10, 10, 4):
        tree = run_git(repository, "mktree", given="".join(f"{kind}\t{n}\n" for n in range(count)))
        kind = f"040000 tree {tree}"
    bomb = run_git(repository, "commit-tree", tree, "-m", "x")
    run_git(repository, "branch", "bomb", bomb)
    tracemalloc.start()
    try:
        with refused_dependency("size", match="files"):
            download.check_out(url, bomb, target, print)
        assert tracemalloc.get_traced_memory()[1] < 3 << 20
        listed = run_git(repository, "ls-tree", "-r", "-l", bomb)
        assert tracemalloc.get_traced_memory()[1] > 4 << 20, "the control failed: it is no bomb"
    finally:
        tracemalloc.stop()
    assert listed.count("\n") == 4 * 10**4 - 1


def test_what_git_writes_is_bounded(
    url: str, repository: Path, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what it lists; and by the kernel while it fetches, before there is a list."""
    monkeypatch.setattr(commits, "MAX_BYTES", 3 << 20)
    for number in range(4):
        (repository / f"zeros{number}").write_bytes(bytes(1 << 20))
    with refused_dependency("size", match="of files"):
        download.check_out(url, commit(repository), target, print)
    (repository / "random").write_bytes(os.urandom(4 << 20))
    with refused_dependency("index", match="git fetch failed"):
        download.check_out(url, commit(repository), target, print)
    assert not list(target.iterdir())


# --- What sources say of their build, what a build lacked, and downloads: all of it is data


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
def test_how_to_build(tmp_path: Path, text: str | None, requires: list[str], backend: str) -> None:
    """As the standards have it: setuptools is what builds where nothing is said."""
    if text is not None:
        (tmp_path / "pyproject.toml").write_text(text)
    found = project.read(tmp_path, "x 1.0")
    assert [str(one.requirement) for one in found.requires] == requires
    assert found.backend == backend


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
    with refused_dependency("requirement", match=r"x 1\.0"):
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
    assert project.wheel_for("error: command 'swig' failed: No such file or directory") == "swig<5"
    assert project.wheel_for("error: command 'gcc' failed: No such file or directory") == ""
    assert project.advice("No such file or directory: 'README.md'\nSyntaxError") == ""


def test_downloads_are_bounded_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    shelf, target = tmp_path / "shelf", tmp_path / "target"
    shelf.mkdir()
    (shelf / "x-1.tar.gz").write_bytes(b"data")
    known = hashlib.sha256(b"data").hexdigest()
    with served(shelf) as index:
        url = index.url.replace("/simple", "/files/x-1.tar.gz")
        download.download(url, known, target)
        assert target.read_bytes() == b"data"
        index.replaced["x-1.tar.gz"] = b"tada" * 9
        with refused_dependency("integrity", match="it was replaced"):
            download.download(url, known, target)
        with refused_dependency("index", match="404"):
            download.download(url + "x", known, target)
        monkeypatch.setattr(download, "MAX_BYTES", 3)
        with refused_dependency("size"):
            download.download(url, known, target)
        assert target.stat().st_size == 4, "it writes what it refuses"
    for other in ("ftp://127.0.0.1/x", "http://127.0.0.1:1/x", "file:///dev/zero"):
        with refused_dependency("index"):
            download.download(other, known, target)


def test_a_login_goes_to_its_index_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UV_INDEX", "mine=https://me:secret@index.example/simple")
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    assert download.login_for("https://index.example/x") == ("me", "secret")
    assert download.login_for("https://other.example/x") is None
    with refused_dependency("index") as caught:
        download.download("http://me:secret@127.0.0.1:1/x", "", tmp_path / "x")
    assert "secret" not in str(caught.value)


def test_no_login_follows_a_redirect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1,localhost")
    sent: list[str | None] = []

    class Handler(QuietHandler):
        def do_GET(self) -> None:
            sent.append(self.headers["Authorization"])
            self.send_response(302 if self.path == "/x" else 200)
            self.send_header("Location", f"{elsewhere}/y")
            self.send_header("Content-Length", "4")
            self.end_headers()
            self.wfile.write(b"data")

    with serving(Handler) as where:
        elsewhere = where.replace("127.0.0.1", "localhost")
        url = f"{where.replace('//', '//me:secret@')}/x"
        download.download(url, hashlib.sha256(b"data").hexdigest(), tmp_path / "x")
    assert sent == [authorization(("me", "secret")), None]


def test_a_long_word_costs_no_search_from_each_letter() -> None:
    began = time.process_time()
    assert project.advice("x" * 30_000) == ""  # with one: 45 s
    assert time.process_time() - began < 5

"""Hostile repositories of git, by reference: no program runs, nothing else is asked, no lie holds.
The control is plain git with the same repository and the same user: there each of them succeeds."""

import contextlib
import os
import shutil
import socket
import subprocess
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from envhub_sandbox import errors
from envhub_sandbox.extras.sources import git_address as address
from envhub_sandbox.extras.sources import git_commits as commits
from envhub_sandbox.hub.answers import HubFailure
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, snapshot_named
from tests.support.packages.git_server import commit, git, git_served, make_repository, ran
from tests.support.ports import QuietHandler, serving
from tests.support.repositories import CARTPOLE

pytestmark = [pytest.mark.skipif(shutil.which("git") is None, reason="needs git")]


@pytest.fixture
def repository(tmp_path: Path, snapshot_store: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One with an environment; http is permitted here alone, and its user has a home."""
    monkeypatch.setattr(address, "PROTOCOLS", ("http",))
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")
    (tmp_path / "home").mkdir()
    made = tmp_path / "served" / "org" / "repo"
    make_repository(made, {"env.py": CARTPOLE})
    return made


@contextmanager
def canary(status: int = 404) -> Iterator[tuple[str, list[BaseHTTPRequestHandler]]]:
    """A server that nobody should ask: its address, and who did."""
    asked: list[BaseHTTPRequestHandler] = []

    class Handler(QuietHandler):
        def do_GET(self) -> None:
            asked.append(self)
            self.send_response(status)
            self.send_header("WWW-Authenticate", 'Basic realm="x"')
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_POST = do_GET

    with serving(Handler) as where:
        yield where, asked


def plain_git(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    """Git as this user runs it, with his settings."""
    return subprocess.run(
        ["git", *arguments],
        capture_output=True,
        check=False,
        stdin=subprocess.DEVNULL,
        env={**os.environ, "GIT_TERMINAL_PROMPT": "0"},
        timeout=60,
    )


def setting(text: str) -> None:
    with Path(os.environ["HOME"], ".gitconfig").open("a") as file:
        file.write(text)


def hooked(repository: Path, program: Path) -> None:
    """A hook in the templates that this user's git copies into each repository."""
    hooks = program.parent / "template" / "hooks"
    hooks.mkdir(parents=True)
    for name in ("post-checkout", "reference-transaction", "pre-auto-gc"):
        shutil.copy(program, hooks / name)
    setting(f"[init]\n\ttemplateDir = {hooks.parent}\n")


def filtered(repository: Path, program: Path) -> None:
    """The repository asks for a filter that this user has, as for files of LFS."""
    setting(f'[filter "lfs"]\n\tsmudge = {program}\n')
    (repository / ".gitattributes").write_text("*.py filter=lfs\n")
    commit(repository)


def rerouted(repository: Path, program: Path) -> None:
    """An address that this user's git replaces by a program."""
    setting(f'[url "ext::{program} "]\n\tinsteadOf = http://\n[protocol]\n\tallow = always\n')


def watched(repository: Path, program: Path) -> None:
    """A program that this user's git asks."""
    setting(f"[core]\n\tfsmonitor = {program}\n")


@pytest.mark.parametrize("trap", [hooked, filtered, rerouted, watched])
def test_no_program_runs(
    repository: Path, program: Path, trap: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    trap(repository, program)
    with git_served(tmp_path / "served") as where:
        plain_git("clone", f"{where}/org/repo", str(tmp_path / "clone"))
        plain_git("-C", str(tmp_path / "clone"), "status")
        assert ran(program), "the control failed"
        found = snapshot_named(f"git+{where}/org/repo")
    assert not ran(program)
    assert (found.root / "env.py").read_text() == CARTPOLE


def test_variables_of_the_user_do_nothing(
    repository: Path, program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = {f"url.ext::{program} .insteadOf": "http://", "protocol.allow": "always"}
    monkeypatch.setenv("GIT_CONFIG_COUNT", str(len(pairs)))
    for number, (key, value) in enumerate(pairs.items()):
        monkeypatch.setenv(f"GIT_CONFIG_KEY_{number}", key)
        monkeypatch.setenv(f"GIT_CONFIG_VALUE_{number}", value)
    with git_served(tmp_path / "served") as where:
        plain_git("ls-remote", f"{where}/org/repo")
        assert ran(program), "the control failed"
        snapshot_named(f"git+{where}/org/repo")
    assert not ran(program)


def test_submodules_are_not_fetched(
    repository: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with canary() as (elsewhere, asked), git_served(tmp_path / "served") as where:
        text = f'[submodule "m"]\n\tpath = m\n\turl = {elsewhere}/m\n'
        (repository / ".gitmodules").write_text(text)
        git(repository, "update-index", "--add", "--cacheinfo", f"160000,{'1' * 40},m")
        git(repository, "add", ".gitmodules")
        git(repository, "commit", "--quiet", "--message=x")
        clone = str(tmp_path / "clone")
        plain_git("clone", "--recurse-submodules", f"{where}/org/repo", clone)
        assert asked, "the control failed"
        asked.clear()
        with caplog.at_level("WARNING"):
            found = snapshot_named(f"git+{where}/org/repo")
        assert not asked
    assert "submodules are left out: 'm'" in caplog.text
    assert {file.path for file in found.files} == {"env.py", ".gitmodules"}


def test_alternates_are_not_followed(repository: Path, tmp_path: Path) -> None:
    """A server of plain files says where further objects are; git may be set to ask there."""
    git(repository, "update-server-info")
    files = repository / ".git"
    head = git(repository, "rev-parse", "HEAD")
    with canary() as (elsewhere, asked), served_plainly(files) as where:
        (files / "objects/info").mkdir(exist_ok=True)
        (files / "objects/info/http-alternates").write_text(f"{elsewhere}/objects\n")
        blob = git(repository, "rev-parse", "HEAD:env.py")
        (files / "objects" / blob[:2] / blob[2:]).unlink()
        clone = str(tmp_path / "clone")
        plain_git("-c", "http.followRedirects=true", "clone", f"{where}/x", clone)
        assert asked, "the control failed"
        asked.clear()
        with pytest.raises(errors.EnvHubError):
            snapshot_named(f"git+{where}/x@{head}")
        assert not asked


@contextmanager
def served_plainly(folder: Path) -> Iterator[str]:
    """Its files, below any first step of a path, as a server that knows nothing of git."""

    class Handler(QuietHandler):
        def do_GET(self) -> None:
            path = folder / self.path.partition("?")[0].strip("/").partition("/")[2]
            data = path.read_bytes() if path.is_file() else None
            self.send_response(404 if data is None else 200)
            self.send_header("Content-Length", str(len(data or b"")))
            self.end_headers()
            self.wfile.write(data or b"")

    with serving(Handler) as where:
        yield where


def test_no_login_is_sent(
    repository: Path, program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plain git has this user's for any host that asks: from .netrc, or of a helper's."""
    netrc = Path(os.environ["HOME"], ".netrc")
    netrc.write_text("machine 127.0.0.1 login jane password hunter2\n")
    netrc.chmod(0o600)
    setting(f"[credential]\n\thelper = {program}\n")
    with canary(401) as (where, asked):
        plain_git("ls-remote", f"{where}/org/repo")
        assert any("Authorization" in one.headers for one in asked), "the control failed"
        assert ran(program), "the control failed"
        asked.clear()
        with pytest.raises(errors.RepositoryUnavailableError):
            snapshot_named(f"git+{where}/org/repo")
        assert asked
        assert not any("Authorization" in one.headers for one in asked)
    assert not ran(program)


def test_a_commit_is_the_one_that_was_asked_for(repository: Path, tmp_path: Path) -> None:
    """The server answers for another. By a name plain git has to believe it; a commit is a hash."""
    approved = git(repository, "rev-parse", "HEAD")
    (repository / "env.py").write_text(CARTPOLE + "# evil\n")
    evil = commit(repository)

    def lying(body: bytes) -> bytes:
        return body.replace(approved.encode(), evil.encode())

    def brought(where: str, revision: str) -> Snapshot:
        return snapshot_named(f"git+{where}/org/repo@{revision}")

    with git_served(tmp_path / "served", lying) as where:
        clone = str(tmp_path / "clone")
        plain_git("clone", f"{where}/org/repo", clone)
        assert "# evil" in Path(clone, "env.py").read_text(), "the control failed"
        assert "# evil" in (brought(where, "main").root / "env.py").read_text()
        with pytest.raises(errors.RepositoryUnavailableError, match="git"):
            brought(where, approved)
        assert commits.day_of(f"{where}/org/repo", evil)
        with pytest.raises(HubFailure, match="git"):  # fetched without files
            commits.day_of(f"{where}/org/repo", approved)
    with git_served(tmp_path / "served") as where:
        assert "# evil" not in (brought(where, approved).root / "env.py").read_text()


OPTION = "--upload-pack={}"


@pytest.mark.parametrize(
    "text",
    [
        *("git+https://h/x@{}", "git+{}", "github:{}", "github:org/{}", "git+https://{}/x"),
        *("git+ext::{}", "git+file://{}", "git+ssh://{}/x", "ext::{}", "file://{}"),
    ],
)
def test_nothing_in_a_reference_is_an_option_or_a_program(
    repository: Path, program: Path, text: str
) -> None:
    option = OPTION.format(program)
    plain_git("ls-remote", option, str(repository))
    assert ran(program), "the control failed"
    for hostile in (option, str(program)):
        with pytest.raises(errors.HubReferenceError):
            HubRef.parse(text.format(hostile))
        with pytest.raises((errors.HubReferenceError, errors.EnvHubError)):
            snapshot_named(text.format(hostile))
        with pytest.raises(errors.HubReferenceError):
            commits.resolve(text.format(hostile).removeprefix("git+"), "main")
    for revision in (option, f"main {option}", "a..b"):
        with pytest.raises(errors.HubReferenceError):
            commits.resolve("http://127.0.0.1:9/x", revision)
    assert not ran(program)


def test_names_of_files_cost_no_memory(repository: Path, tmp_path: Path) -> None:
    """Each row of git's listing repeats the folder's name: a few hundred bytes become 40 MB."""
    blob = git(repository, "rev-parse", "HEAD:env.py")
    rows = "".join(f"100644 blob {blob}\tf{number}\n" for number in range(2000))
    inner = git(repository, "mktree", given=rows)
    tree = git(repository, "mktree", given=f"040000 tree {inner}\t{'d' * 20_000}\n")
    head = git(repository, "commit-tree", tree, "-m", "x")
    git(repository, "update-ref", "refs/heads/main", head)
    with git_served(tmp_path / "served") as where:
        listed = plain_git("-C", str(repository), "ls-tree", "-r", "main").stdout
        assert len(listed) > 40_000_000, "the control failed"
        tracemalloc.start()
        try:
            with pytest.raises(errors.SnapshotTooLargeError, match="a name that is too long"):
                snapshot_named(f"git+{where}/org/repo")
            assert tracemalloc.get_traced_memory()[1] < 20_000_000
        finally:
            tracemalloc.stop()


def test_names_of_branches_may_be_any_bytes(repository: Path, tmp_path: Path) -> None:
    """What ends with the wanted name comes along, whatever stands in front of it."""
    head = git(repository, "rev-parse", "HEAD")
    odd = b"refs/heads/\xff/refs/heads/main"
    (repository / ".git" / "packed-refs").write_bytes(head.encode() + b" " + odd + b"\n")
    with git_served(tmp_path / "served") as where:
        shown = plain_git("ls-remote", f"{where}/org/repo", "refs/heads/main").stdout
        assert odd in shown, "the control failed"
        assert commits.resolve(f"{where}/org/repo", "main") == head


@contextmanager
def dripping() -> Iterator[tuple[str, threading.Event]]:
    """A server whose answer never ends: its address, and whether the client has gone."""
    gone, over = threading.Event(), threading.Event()
    listener = socket.create_server(("127.0.0.1", 0))
    kind = "application/x-git-upload-pack-advertisement"

    def serve() -> None:
        with contextlib.suppress(OSError), listener.accept()[0] as client:
            client.recv(1 << 16)
            client.sendall(f"HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\n\r\n".encode())
            while not over.wait(0.05):
                client.sendall(b"0")
        if not over.is_set():
            gone.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/org/repo", gone
    finally:
        over.set()
        listener.shutdown(socket.SHUT_RDWR)  # nobody may have come
        thread.join()
        listener.close()


def test_a_server_that_never_ends_keeps_no_process(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of plain git that is ended the children stay, for as long as the server likes."""
    with dripping() as (url, gone):
        with pytest.raises(subprocess.TimeoutExpired):
            subprocess.run(["git", "ls-remote", url], capture_output=False, timeout=3, check=True)
        assert not gone.wait(1), "the control failed"
    monkeypatch.setattr(commits, "TIMEOUT_S", 10.0)
    monkeypatch.setattr(commits, "DAY_S", 9.0)  # an error waits for it
    for ask, name, late_s in ((commits.resolve, "main", 10), (commits.day_of, "a" * 40, 9)):
        with dripping() as (url, gone):
            with pytest.raises(HubFailure, match=f"took longer than {late_s} s"):
                ask(url, name)
            assert gone.wait(60)

"""Each command by itself: what it does without a jail, and what it refuses before it opens one."""

import ast
import json
import os
import shlex
import shutil
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from envhub_sandbox import __version__
from envhub_sandbox.cli import cache
from envhub_sandbox.cli.app import app
from envhub_sandbox.cli.shared import exits, host
from envhub_sandbox.cli.shared.console import guarded
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.extras.judge import reports
from envhub_sandbox.extras.judge.command import findings
from envhub_sandbox.extras.judge.findings import Finding, Report
from envhub_sandbox.extras.remote import doctor as doctor_server
from envhub_sandbox.extras.sources.checkout import make_checkout
from envhub_sandbox.extras.starter import command as init
from envhub_worker.protocol import messages as m
from tests.attacks.client.lying_server import LyingServer, lying


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder, and nothing of this user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("ENVHUB_CONFIG", str(tmp_path / "config"))


def said(*words: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, words)
    return done.exit_code, done.output


_NO_FOLDER = "there is no such folder or file here"
_REFUSED = [
    ("lock a/b/c/d", 2, "the path comes after a colon"),
    ("lock --check ./gone.toml", 2, "'envhub lock REF' writes one"),
    ("image build ./gone", 3, _NO_FOLDER),
    ("replay ./gone", 2, "cannot be read as a crash bundle"),
    ("diff ./gone ./gone", 3, _NO_FOLDER),
    ("run ./gone", 3, _NO_FOLDER),
    ("run 'no spaces allowed'", 2, "Error: hub reference 'no spaces allowed'"),
    ("inspect --download ./gone", 3, _NO_FOLDER),
    ("inspect ./gone --upgrade", 2, "it needs --static or --download"),
    ("lock ./gone --no-index", 2, "it needs --check FILE"),
    ("lock", 2, "name what to lock"),
    ("cache remove gone", 2, "the cache has nothing named 'gone'"),
    ("doctor --profile gone", 2, "it is one of strict, no-userns, container"),
    ("doctor tcp://host", 2, "a remote server is tcp://HOST:PORT"),
    ("doctor tcp://127.0.0.1:9", 6, "another program could imitate that server"),
    ("init a--b", 2, "is not a valid name on the Hub"),
    ("inspect ./gone", 3, _NO_FOLDER),
    ("inspect ./gone --sarif x", 2, "--sarif means nothing here"),
    ("inspect ./gone --static --render", 2, "No such option"),
    ("inspect ./gone --static --n-envs 2", 2, "--n-envs means nothing here: with --static nothing"),
    ("inspect ./gone --static --async", 2, "--async means nothing here"),
    ("inspect ./gone --static --fail-on never", 2, "it takes error, warning or note"),
    ("inspect ./gone --fail-on note", 2, "--fail-on means nothing here: it needs --static"),
    ("check ./gone --allow seeding_", 2, "did you mean 'seeding'?"),
]


@pytest.mark.parametrize(("words", "code", "text"), _REFUSED)
def test_what_cannot_be_done_is_said_in_one_line(words: str, code: int, text: str) -> None:
    found, printed = said(*shlex.split(words))
    assert (found, text in " ".join(printed.split())) == (code, True), printed
    assert "Traceback" not in printed
    assert os.listdir() == []


def test_an_empty_store_is_listed() -> None:
    code, printed = said("cache", "list")
    assert (code, printed.startswith("0 snapshots, 0 environments")) == (0, True)
    code, printed = said("cache", "list", "--json")
    assert json.loads(printed)["snapshots"] == []
    assert cache.stored_snapshots() == []


def test_a_snapshot_is_called_by_repository_or_commit() -> None:
    one = cache.StoredSnapshot("org/repo", "0123456789", None, 0.0, 1, Path())
    for name in ("org/repo", "0123456", "org/repo@01", "0123456789"):
        assert one.answers_to(name), name
    for name in ("012345", "org/repo@1", "org", "other/repo@0123456", "1234567"):
        assert not one.answers_to(name), name


@pytest.mark.parametrize("name", ["my-env", "a", "A.b_c", "x" * 96])
def test_a_repository_has_the_name_of_its_folder(name: str) -> None:
    assert init.repository_name(Path(name)) == name
    files = init.starter(name, 2026)
    assert {"env.py", "README.md", "LICENSE"} <= set(files)
    for path, text in files.items():
        assert "$" not in text.replace("${{", ""), path
        if path.endswith(".py"):
            ast.parse(text)
    assert name in files["env.py"]
    assert "2026" in files["LICENSE"]
    for wrong in ("-a", "a.", "a..b", "a--b", "a.git", ".env", "x" * 97, "é"):
        with pytest.raises(exits.UsageError, match="is not a valid name on the Hub"):
            init.repository_name(Path(wrong))


def test_init_writes_all_or_nothing() -> None:
    Path("there").mkdir()
    Path("there/file").touch()
    assert said("init", "there")[0] == 2
    assert os.listdir("there") == ["file"]


def test_reports_are_written_in_utf_8() -> None:
    findings.write_report(Path("report"), "ü", ["org/repo"])
    assert Path("report").read_bytes() == "ü".encode()
    with pytest.raises(exits.UsageError, match="the report cannot be written"):
        findings.write_report(Path("no/report"), "", ["org/repo"])


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_report_is_not_written_through_a_link_of_the_repository() -> None:
    """``./`` is a checkout in CI, where the report's usual name can be a link of its author's."""
    Path("env").mkdir()
    Path("env/env.py").touch()
    make_checkout(Path("env"))
    Path("env/sub").mkdir()
    Path("env/sub/env.py").touch()
    Path("victim").write_text("mine")
    for words in ("inspect ./env --static", "check ./env/sub --deadline 1"):
        said(*words.split(), "--sarif", "env/new")
        assert Path("env/new").read_text().startswith("{")
        Path("env/new").unlink()
        Path("env/link").symlink_to(Path("victim").absolute())
        code, text = said(*words.split(), "--sarif", "env/link")
        assert (code, "env/link is, or lies behind, a link in" in text) == (2, True), text
        assert not Path("env/link").is_symlink(), "and no other file is taken for a report"
    assert Path("victim").read_text() == "mine"


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
@pytest.mark.parametrize("words", ["inspect {} --static", "check {}"])
@pytest.mark.parametrize("folder", ["./env", "./env/gone"])
def test_where_there_is_no_report_none_of_the_repository_stands(words: str, folder: str) -> None:
    """CI would show what its author has written; the controls are files that are not his."""
    Path("env").mkdir()
    make_checkout(Path("env"))
    Path("env/a\\b").touch()  # no repository has such a name
    Path("env/up").symlink_to(Path.cwd())
    for place, is_left in (("env/report", False), ("env/up/mine", True), ("mine", True)):
        Path(place).write_text("all passed")
        code, text = said(*words.format(folder).split(), "--sarif", place)
        assert (code, Path(place).exists()) == (3, is_left), text


def test_annotations_are_for_the_job_and_its_summary(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = Path("summary")
    summary.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    with guarded():
        findings.annotate(["::notice::one", "::error::two"], "after\n")
    assert capsys.readouterr().out == "::notice::one\n::error::two\n"
    assert summary.read_text() == "before\nafter\n"
    flood = [Finding("runs", "(" * 1_000, f"a / {number}") for number in range(500)]
    summary.unlink()
    with guarded():
        findings.annotate([], reports.summary(Report("org/repo", flood), flood))
    lines = summary.read_text().splitlines()
    assert summary.stat().st_size <= 1 << 20, "or GitHub shows nothing of it"
    assert lines[-1] == f"{500 - sum(' runs ' in line for line in lines)} more are left out."


def test_a_warning_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Without the file and the line of this package that gave it; outside it is Python's again."""
    before = warnings.showwarning
    with warnings.catch_warnings(), guarded():
        warnings.simplefilter("always")
        warnings.warn("a stub stands in\n::error::obey", stacklevel=1)
    assert capsys.readouterr().err == "Warning: a stub stands in\n:\\x3aerror::obey\n"
    assert warnings.showwarning is before


def test_versions_of_all_that_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = said("--version")[1]
    found = {line.split()[0]: line.split()[1] for line in printed.splitlines()}
    assert found["envhub-sandbox"] == __version__
    assert {"protocol", "python", "gymnasium", "huggingface_hub"} <= set(found)
    assert host.versions()["numpy"] == found["numpy"]

    def gone(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", gone)
    assert host.versions()["numpy"] is None


# --- ``envhub doctor tcp://HOST:PORT``: a server's words become a verdict, and nothing but text


SAID: dict[Any, Any] = {
    "python": "3.12.1", "profile": "no-userns", "weakest_profile": "container", "network": True,
    "quotas": {"jails": 4000, "memory_bytes": 3 << 30, "other": 7}, "draining_s": None,
    "clients": {"alice": {"jails": 1200, "memory_limit_bytes": 1 << 30}},
}  # fmt: skip
Examine = Callable[..., Exit]


class _Place:
    """A server that is reached by a socket in a folder, without keys."""

    insecure_loopback = True

    def __init__(self, server: LyingServer) -> None:
        self.endpoint = server.endpoint

    def far(self) -> None:
        """It is here."""


@pytest.fixture
def looks() -> Iterator[Examine]:
    """``examine`` of a server that says this of itself."""
    with lying() as server:

        def run(said: dict[Any, Any], profile: str = "no-userns", *, json: bool = False) -> Exit:
            answer = m.Sessions((), said)
            server.lies[m.GetSessions] = lambda asked: [asked.answer(answer)]
            return doctor_server.examine_server(_Place(server), profile, json=json)

        yield run


def test_quotas_stand_beside_usage(looks: Examine, capsys: pytest.CaptureFixture[str]) -> None:
    assert looks(SAID) is Exit.OK
    text = capsys.readouterr().out
    rows = [line.split() for line in text.splitlines()]
    assert ["jails", "1,200", "4,000"] in rows
    assert ["other", "7"] in rows
    assert "permits network" in " ".join(text.split())
    [memory] = [row for row in rows if row[:1] == ["memory"]]
    assert memory[1][0] == "1"
    assert "3" in memory[-2] + memory[-1]


@pytest.mark.parametrize(
    ("changed", "profile", "code", "said"),
    [
        ({}, "strict", Exit.SANDBOX, "'no-userns' is the strongest"),
        ({"profile": "magic"}, "no-userns", Exit.SANDBOX, "no jail with the profile"),
        ({"draining_s": 3.0}, "no-userns", Exit.WORKER, "it drains"),
        ({"draining_s": 3.0}, "strict", Exit.WORKER, "it drains"),
    ],
)
def test_the_code_is_the_verdict(
    looks: Examine,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, Any],
    profile: str,
    code: Exit,
    said: str,
) -> None:
    assert looks(SAID | changed, profile) is code
    assert said in " ".join(capsys.readouterr().out.split())
    assert looks(SAID | changed, profile, json=True) is code
    document = json.loads(capsys.readouterr().out)
    assert (document["code"], document["profile"]) == (code, profile)
    assert said in document["problem"]
    assert document["server"]["quotas"] == SAID["quotas"]


def test_the_names_of_quotas_paint_nothing(
    looks: Examine, capsys: pytest.CaptureFixture[str]
) -> None:
    looks(SAID | {"quotas": {"a\n\x1b[2J[red]b_bytes": 1}})
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert "[red]b" in text.splitlines()[-1]

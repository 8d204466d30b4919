"""``envhub check --all``: what is asked for is checked before anything is run."""

import json
import shutil
import signal
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import typer
from typer.testing import CliRunner, Result

from envhub_sandbox.cli.app import app, whole_command
from envhub_sandbox.cli.shared.console import guarded
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.errors import SnapshotError, remote_error
from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.command import check as command
from envhub_sandbox.extras.judge.command import list_run
from envhub_sandbox.extras.judge.command.check import SETTINGS
from envhub_sandbox.extras.judge.command.deadline import DeadlineReached, deadline_alarm
from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.references import ListEntry
from envhub_sandbox.extras.sources.checkout import make_checkout
from tests.support.output.pages import HOSTILE

_RUNNER = CliRunner()


@pytest.fixture
def judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, Any]]]:
    """What would be judged, and how; each could not be."""
    found: list[tuple[str, dict[str, Any]]] = []

    def judge(make: Any, *_: Any, **play: Any) -> Report:
        found.append((make.ref, play))
        raise SnapshotError("not there")

    monkeypatch.setattr(command, "judgement", judge)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list").write_text("org/repo\n./env\n")
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "envhub.toml").touch()
    return found


Judged = list[tuple[str, dict[str, Any]]]


def called(*arguments: str) -> Result:
    return _RUNNER.invoke(app, ["check", *arguments])


def test_each_is_judged_by_what_holds_here(judged: Judged) -> None:
    Path("settings.toml").write_text("[check]\nsteps = 7\n")
    done = called("--all", "list", "--settings", "settings.toml", "--resets", "0", "--json")
    assert done.exit_code == Exit.UNJUDGED, done.output
    assert [ref for ref, _ in judged] == ["org/repo", "./env"]
    assert all((play["steps"], play["resets"]) == (7, 0) for _, play in judged)
    rows = json.loads(done.stdout)["results"]
    assert [(row["verdict"], row["why"]) for row in rows] == [("not judged", ["not there"])] * 2
    assert {one.name for one in whole_command("check").params} > set(SETTINGS)


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_list_of_the_judged_is_taken_with_a_word(judged: Judged) -> None:
    """Its author could leave something out. The control is a list that lies elsewhere."""
    assert "Warning: " not in called("--all", "list").output
    make_checkout(Path("env"))
    Path("env/list").write_text("./env\n")
    warned = called("--all", "env/list")
    assert "Warning: env/list lies in the checkout of ./env" in warned.output
    assert warned.exit_code == Exit.UNJUDGED
    assert [ref for ref, _ in judged[2:]] == ["./env"]


def test_a_report_that_is_not_written_is_not_there(judged: Judged) -> None:
    """CI would take a file of the checkout's own for it."""
    Path("junit").write_text("all passed")
    Path("list").write_text("nothing\n")
    assert called("--all", "list", "--junit", "junit").exit_code == Exit.USAGE
    assert not Path("junit").exists()
    assert judged == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("--all list org/repo", "not both"),
        ("--all list --sarif x", "--sarif is about one repository"),
        ("--all list --fail-on never", "error, warning or note"),
        ("--all list --allow nothing", "there are: requirements"),
        ("--all list --memory much", "takes a size"),
        ("--all nowhere", "cannot be read"),
        ("--all list --policy nowhere.toml", "cannot be read"),
        ("--all list --policy unit", "unit: limits: memory_bytes is '2'; that is 2 bytes"),
        ("--all list --policy env/envhub.toml", "is inside the repository that is checked, ./env"),
        ("./env --policy env/x", "--policy env/x is inside the repository that is checked, ./env"),
        ("./env --settings env/envhub.toml", "is inside the repository that is checked, ./env"),
        ("--all list --deadline inf", "--deadline is inf"),
        ("--all list --settings env/x.toml", "cannot be read"),
        ("--all wrong", "wrong:2: "),
        ("", "name a repository, or a list"),
    ],
)
def test_what_cannot_be_is_told_first(arguments: str, says: str, judged: Judged) -> None:
    Path("wrong").write_text("org/repo\nrepo\n")
    Path("unit").write_text('[limits]\nmemory_bytes = "2"\n')
    done = called(*arguments.split())
    assert done.exit_code == Exit.USAGE, done.output
    assert says in " ".join(done.output.split())
    assert judged == []


PASSES, FAILS, LATE, ABSENT, PIPE = "passes", "fails", "late", "absent", "pipe"


def results_of(outcomes: Sequence[str], text: str = "it broke") -> list[list_run.Result]:
    """Of a list whose repositories end like this, and say so in a stranger's words."""

    def judge(reference: str) -> Report:
        report, outcome = Report(text), reference.partition("/")[2]
        if outcome == ABSENT:
            raise SnapshotError(text)
        if outcome == PIPE:
            raise remote_error("BrokenPipeError", "BrokenPipeError", text)
        if outcome == "no reader":
            raise BrokenPipeError
        if outcome == LATE:
            report.stopped(1, text)
        report.judged("runs", [text] if outcome == FAILS else [], text)
        return report

    names = [f"{number}/{outcome}" for number, outcome in enumerate(outcomes)]
    entries = [ListEntry(name, name, number) for number, name in enumerate(names)]
    failures = partial(Report.failures, fail_on=Severity.ERROR)
    return [list_run.judge_entry(entry, judge, failures) for entry in entries]


@pytest.mark.parametrize(
    ("outcomes", "code"),
    [
        ([PASSES, PASSES], Exit.OK),
        ([PASSES, ABSENT], Exit.UNJUDGED),
        ([PIPE, FAILS], Exit.ENVIRONMENT),  # which ends no other, as a reader that has gone does
        ([LATE, PASSES], Exit.UNJUDGED),
        ([ABSENT, FAILS, PASSES], Exit.ENVIRONMENT),
        ([], Exit.UNJUDGED),
    ],
)
def test_the_worst_counts(outcomes: list[str], code: Exit) -> None:
    assert list_run.exit_code(results_of(outcomes)) is code
    with pytest.raises(BrokenPipeError):  # the control: of what is printed
        results_of([*outcomes, "no reader"])


@pytest.mark.parametrize("text", HOSTILE)
def test_a_strangers_words_are_text_in_every_form(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary"))
    results = results_of([FAILS, ABSENT], text)
    list_run.write_junit(tmp_path / "junit", results)
    suites = ElementTree.parse(tmp_path / "junit").getroot()
    assert (suites.attrib["failures"], suites.attrib["errors"]) == ("1", "1")
    with guarded(), pytest.raises(typer.Exit):
        list_run.show_results(results, json=False, github=True)
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(" ")[0] for line in lines] == ["::error", "::error"]
    table = (tmp_path / "summary").read_text().splitlines()
    rows = [line for line in table if line.startswith(("| failed", "| not judged"))]
    assert [row.count("|") for row in rows] == [4, 4]
    assert not set("<>[]!`") & set("".join(table))


# --- ``--deadline`` interrupts what takes longer, whatever error is made of the interrupt


@pytest.mark.parametrize("translates", [False, True])
def test_what_takes_longer_is_interrupted(translates: bool) -> None:
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(DeadlineReached), deadline_alarm(0.01):
        wait(translates)
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def wait(translates: bool) -> None:
    try:
        threading.Event().wait(60)
    except KeyboardInterrupt as error:
        if translates:
            raise OSError("the download broke off") from error
        raise


def test_an_error_before_it_is_what_it_is() -> None:
    with pytest.raises(OSError, match="its own"), deadline_alarm(60):
        raise OSError("its own")
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)

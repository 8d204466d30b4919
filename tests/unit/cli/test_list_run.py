"""``envhub check --all``: what is asked for is checked before anything is run."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import threading
from dataclasses import fields
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from envhub_sandbox.check import reports
from envhub_sandbox.check.checks import CHECKS, Severity
from envhub_sandbox.check.findings import Report
from envhub_sandbox.check.many.entries import ListEntry
from envhub_sandbox.check.many.judgements import Outcome
from envhub_sandbox.check.many.results import Result as Judgement
from envhub_sandbox.check.many.results import Verdict
from envhub_sandbox.cli.app import app, whole_command
from envhub_sandbox.cli.check import list_run
from envhub_sandbox.cli.check.check import OF_A_LIST, SETTINGS, check
from envhub_sandbox.cli.check.deadline import DeadlineReached, deadline_alarm
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.hub.git.checkout import make_checkout
from tests.hub.olah_server import git

_RUNNER = CliRunner()


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, list[str]]]:
    """How many may run at once, and what would be run; each could not be judged, by its exit code:
    the report and the page that it has say that it passed.
    """
    found: list[tuple[int, list[str]]] = []
    passed = json.dumps(reports.document(Report("org/repo@abc"), [])).encode()

    def judgements(orders, command, *, folder, jobs, **_):  # type: ignore[no-untyped-def]
        for number, order in enumerate(orders):
            found.append((jobs, command(order, folder / str(number), 7)))
            (folder / "page.html").touch()
            yield Outcome(
                order=order, folder=folder, code=3, seconds=1.0, out=passed, said="Error: not there"
            )

    monkeypatch.setattr(list_run, "judgements", judgements)
    monkeypatch.setattr(list_run, "free_memory_bytes", lambda: 64 << 30)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list").write_text("org/repo\n./env\n")
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "envhub.toml").touch()
    return found


def called(*arguments: str) -> Result:
    return _RUNNER.invoke(app, ["check", *arguments])


def test_each_is_told_what_holds_here(started: list[tuple[int, list[str]]]) -> None:
    """From the command line, or a file; nothing that is about the list, and no secret."""
    Path("settings.toml").write_text("[check]\nsteps = 7\nallow = ['card', 'licence']\n")
    Path("policy.toml").write_text('network = "loopback"\n')
    done = called(
        *("--all", "list", "--output", "out", "--settings", "settings.toml", "--resets", "0"),
        *("--policy", "policy.toml", "--token", "hf_secret", "--async", "--jobs", "1", "--json"),
    )
    assert done.exit_code == Exit.UNJUDGED, done.output
    assert [jobs for jobs, _ in started] == [1, 1]
    for (_, command), reference in zip(started, ("org/repo", "./env"), strict=True):
        assert command[-2:] == ["--", reference]
        assert command[1:3] == ["-I", "-m"], "no module of the folder that one is in"
        words = {word for word in command if word.startswith("--")}
        assert words > {"--steps=7", "--allow=card", "--allow=licence", "--resets=0", "--async"}
        assert not any(word.startswith(("--all=", "--out", "--jobs", "--set")) for word in words)
        assert "hf_secret" not in " ".join(command)
        [policy] = [word for word in words if word.startswith("--policy=")]
        assert policy.endswith(".running/policy.toml")


def test_a_file_says_what_one_may_type_about_a_list(
    started: list[tuple[int, list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what is typed counts more. For one repository the same file is no mistake."""
    seconds: list[float] = []
    faked = list_run.judgements

    def judgements(orders, command, *, most_s, **more):  # type: ignore[no-untyped-def]
        seconds.append(most_s)
        yield from faked(orders, command, **more)

    monkeypatch.setattr(list_run, "judgements", judgements)
    says = "[check]\njobs = 5\nmax-memory = '6G'\ndeadline = 9\nmemory = '1G'\n"
    Path("settings.toml").write_text(says)
    arguments = ("--all", "list", "--output", "out", "--settings", "settings.toml")
    for typed in ((), ("--jobs", "2"), ("--max-memory", "2G"), ("--deadline", "8")):
        done = called(*arguments, *typed)
        assert done.exit_code == Exit.UNJUDGED, done.output
    assert ([jobs for jobs, _ in started[::2]], seconds) == ([3, 2, 1, 3], [69, 69, 69, 68])
    assert all("--memory=1G" in words for _, words in started)
    assert not any(word.startswith("--jobs") for _, words in started for word in words)
    assert [word for _, words in started[::2] for word in words if word.startswith("--dead")] == [
        *("--deadline=9.0", "--deadline=9.0", "--deadline=9.0", "--deadline=8.0")
    ]
    alone = called("./nothing", "--settings", "settings.toml")
    assert "there is no such folder" in alone.output


def test_a_result_counts_for_the_same_commit_judged_in_the_same_way(
    started: list[tuple[int, list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    commit, judged = ["abc"], list[ListEntry]()
    passed = json.dumps(reports.document(Report("x", commit="abc"), [])).encode()
    (folder := Path("made")).mkdir()
    (folder / "page.html").touch()

    def judgements(orders, *_, **__):  # type: ignore[no-untyped-def]
        for one in orders:
            judged.append(one)
            yield Outcome(order=one, folder=folder, code=0, seconds=1.0, out=passed, said="")

    def again(*more: str) -> int:
        judged.clear()
        words = ("--all", "list", "--output", "out", "--policy", "policy.toml", *more)
        assert called(*words).exit_code == Exit.OK
        return len(judged)

    monkeypatch.setattr(list_run, "judgements", judgements)
    monkeypatch.setattr(list_run, "commit_of", lambda *_, **__: commit[0])
    Path("policy.toml").write_text('network = "loopback"')
    assert (again(), again(), again("--again")) == (2, 0, 2)
    assert (again("--steps", "9"), again("--steps", "9"), again()) == (2, 0, 2)
    Path("policy.toml").write_text('network = "none"')
    assert (again(), again()) == (2, 0)
    other = dataclasses.replace(CHECKS["card"], severity=Severity.ERROR)
    monkeypatch.setitem(CHECKS, "card", other)
    assert (again(), again()) == (2, 0)
    commit[0] = "another"
    assert again() == 2


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_no_commit_has_results_of_what_it_has(started: list[tuple[int, list[str]]]) -> None:
    """Its author could write that he has passed; the controls are results that are not his, and
    those of somebody else's repository."""
    words = ("--all", "list", "--output", "out")
    assert called(*words).exit_code == Exit.UNJUDGED
    make_checkout(Path.cwd())
    assert called(*words).exit_code == Exit.UNJUDGED
    git(Path.cwd(), "add", "--force", "out")
    Path("junit").write_text("all passed")
    refused = called(*words, "--junit", "junit")
    assert refused.exit_code == Exit.USAGE
    assert not Path("junit").exists(), "nor is a file of its own taken for the report"
    assert "--output out has files of the commit that is judged" in refused.output
    assert called(*words, "--again").exit_code == Exit.UNJUDGED
    Path("list").write_text("org/repo\n")
    assert called(*words).exit_code == Exit.UNJUDGED


def test_every_option_is_handed_on_or_about_the_list() -> None:
    names = {one.name for one in whole_command("check").params}
    of_the_list = list_run.OF_THE_LIST
    assert names > of_the_list
    assert names > set(SETTINGS)
    assert set(OF_A_LIST) < of_the_list
    handed_on = {"steps", "fail_on", "allow", "timeout", "memory", "profile"}
    assert names - of_the_list > handed_on
    assert check.__doc__ is not None


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("--all list", "needs --output DIR"),
        ("--all list --output out org/repo", "not both"),
        ("--all list --output out --sarif x", "--sarif is about one repository"),
        ("--all list --output out --fail-on never", "error, warning or note"),
        ("--all list --output out --allow nothing", "there are: requirements"),
        ("--all list --output out --memory much", "takes a size"),
        ("--all list --output out --max-memory 4G", "is too little"),
        ("--all list --output out --max-memory much", "--max-memory is 'much'; it takes a size"),
        ("--all nowhere --output out", "cannot be read"),
        ("--all list --output out --policy nowhere.toml", "cannot be read"),
        ("--all list --output .", "has other files"),
        ("--all list --output env/out", "is inside the repository that is checked, ./env (line 2"),
        ("--all list --output out --policy env/x", "--policy env/x is inside the repository"),
        ("./env --policy env/x", "--policy env/x is inside the repository that is checked, ./env"),
        ("./env --settings env/envhub.toml", "is inside the repository that is checked, ./env"),
        ("--all list --output out --deadline inf", "--deadline is inf"),
        ("--all list --output out --settings env/x.toml", "cannot be read"),
        ("--all wrong --output out", "wrong:2: "),
        ("", "name a repository, or a list"),
        ("org/repo --jobs 2", "are for --all FILE"),
    ],
)
def test_what_cannot_be_is_told_first(
    arguments: str, says: str, started: list[tuple[int, list[str]]]
) -> None:
    Path("wrong").write_text("org/repo\nrepo\n")
    done = called(*arguments.split())
    assert done.exit_code == Exit.USAGE, done.output
    assert says in " ".join(done.output.split())
    assert started == []
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("options", "jobs"),
    [
        ("--jobs 3 --memory 1G", 3),
        ("--jobs 3 --memory 1G --max-memory 5G", 2),
        ("--jobs 100 --memory 1G", 32),
        ("--jobs 100", 4),
        ("--jobs 2 --memory 1000G", 1),
    ],
)
def test_limits_stay_within_the_budget(
    options: str, jobs: int, started: list[tuple[int, list[str]]]
) -> None:
    """Two jails each; the budget is what is free, or what is said."""
    done = called("--all", "list", "--output", "out", *options.split())
    assert done.exit_code == Exit.UNJUDGED, done.output
    assert {found for found, _ in started} == {jobs}
    assert ("at once: a judgement may take" in done.output) is (jobs != 3)


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        ([Verdict.PASSED, Verdict.PASSED], Exit.OK),
        ([Verdict.PASSED, Verdict.UNJUDGED], Exit.UNJUDGED),
        ([Verdict.PASSED, Verdict.WAITING], Exit.UNJUDGED),
        ([Verdict.UNJUDGED, Verdict.FAILED], Exit.ENVIRONMENT),
    ],
)
def test_what_fails_counts_most(verdicts: list[Verdict], code: Exit) -> None:
    listed = [ListEntry(f"a/{number}", f"a/{number}", number) for number in range(2)]
    results = [
        Judgement(listed=one, verdict=verdict)
        for one, verdict in zip(listed, verdicts, strict=True)
    ]
    given = dict.fromkeys(one.name for one in fields(list_run.ListRun) if one.init)
    given |= {"of": dict(zip(listed, results, strict=True))}
    assert list_run.ListRun(**given).exit is code


# --- ``--deadline`` interrupts what takes longer, whatever error is made of the interrupt


@pytest.mark.parametrize("translates", [False, True])
def test_what_takes_longer_is_interrupted(translates: bool) -> None:
    """Whatever it waits for, and whatever it makes of the interrupt."""
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

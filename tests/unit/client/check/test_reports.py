"""Reports of ``envhub check``: what a repository writes into them stays text in each form."""

import json
from html import unescape
from xml.etree import ElementTree

import pytest

from envhub_sandbox.extras.judge import reports
from envhub_sandbox.extras.judge.checks import CHECKS, Severity
from envhub_sandbox.extras.judge.findings import Finding, Report
from envhub_sandbox.extras.judge.page import page
from envhub_sandbox.play.confinement import Confinement
from envhub_worker.protocol.text import printable
from tests.support.output.pages import HOSTILE


def report(text: str) -> Report:
    made = Report(text)
    made.add(Finding("runs", text, task=text, file=text, line=3))
    made.judged("loads", [], text)
    return made


@pytest.mark.parametrize("text", [*HOSTILE, "x,col=9"])
def test_what_a_stranger_writes_is_text_in_every_form(text: str) -> None:
    made = report(text)
    [line] = reports.workflow_commands(made)
    assert len(line.splitlines()) == 1, "the control is the text, which has a line of its own"
    head = line.split("title=")[0]
    assert head.startswith("::error file=")
    assert ("\n" in head, head.count("::"), head.count(",")) == (False, 1, 2)
    told = line.split("::", 2)[2].replace("%0A", "\n").replace("%25", "%")  # as GitHub reads it
    assert told.startswith(f"{made.findings[0].message}\n")
    assert line.count("::") == 2 + text.replace("\r", "").count("::")
    table = reports.summary(made, made.findings).splitlines()
    [row] = [line for line in table if line.startswith("| **fails**")]
    assert row.count("|") == 5, "one row of four cells"
    assert not set("<>[]!`") & set("".join(table)), "nothing is a tag, a link or an image"
    suite = ElementTree.fromstring(reports.junit(made, made.findings))
    assert (suite.attrib["tests"], suite.attrib["failures"]) == ("2", "1")
    assert [case.attrib["name"] for case in suite] == ["runs", "loads"]
    [failure] = suite.findall("testcase/failure")
    assert failure.text
    [run] = json.loads(reports.sarif(made, made.findings))["runs"]
    assert [rule["id"] for rule in run["tool"]["driver"]["rules"]] == list(CHECKS)
    place = run["results"][0]["locations"][0]["physicalLocation"]
    assert place["artifactLocation"]["uri"].isascii()
    assert not set(" <>\n") & set(place["artifactLocation"]["uri"])
    assert place["region"] == {"startLine": 3}


def test_files_are_named_from_the_folder_that_ci_is_in() -> None:
    """It has another file of the same name, perhaps."""
    made = Report("./a b:env.py", folder="a b/")
    made.add(Finding("runs", "x", file="env.py", line=3))
    [line] = reports.workflow_commands(made)
    assert line.startswith("::error file=a b/env.py,line=3,")
    [result] = json.loads(reports.sarif(made, []))["runs"][0]["results"]
    place = result["locations"][0]["physicalLocation"]["artifactLocation"]
    assert place == {"uri": "a%20b/env.py"}


def test_names_and_messages_make_no_links() -> None:
    """In a summary a host's name is one without markup; SARIF has placeholders, too."""
    made = report("[Approve](https://example.com) {0} \\ www.example.com/x __bold__")
    [result] = json.loads(reports.sarif(made, made.findings))["runs"][0]["results"]
    assert "\\[Approve\\](" in result["message"]["text"]
    assert "{{0}} \\\\" in result["message"]["text"]
    assert "www.example" not in reports.summary(made, made.findings)
    assert "__" not in reports.summary(made, made.findings)


@pytest.mark.parametrize("text", HOSTILE)
def test_what_confined_it_is_text(text: str) -> None:
    """Of a server on another host: a line is one, a command is one, and a flood is cut."""
    made = Report("./walk:env.py")
    layers = [{"layer": text, "enforced": text, "detail": text}] * 1_000  # True alone holds
    held = {"layer": "seccomp", "enforced": True, "detail": ""}
    provenance = {"profile": "container", "layers": [held, *layers]}
    made.confinement = Confinement.of("strict", provenance, text * 1_000)
    lines = list(made.confinement.lines())
    assert lines[0] == "confined by: container, 1 layer, in a container; strict was asked for"
    assert (len(lines), max(map(len, lines)) < 1_000) == (42, True)
    assert all(len(line.splitlines()) == 1 and printable(line) == line for line in lines)
    [command] = reports.workflow_commands(made)
    assert (len(command.splitlines()), command.startswith("::notice title=")) == (1, True)
    summary = [line for line in reports.summary(made, []).splitlines() if line.startswith("- ")]
    assert len(summary) == 42
    assert not set("<>[]!`|") & set("".join(summary))
    told = json.loads(json.dumps(reports.document(made, [])))["confinement"]
    assert (told["asked"], told["profile"], told["recorded"]) == ("strict", "container", False)
    assert "seccomp" not in {one["layer"] for one in told["missing"]}


def test_all_that_there_can_be_is_a_line_and_no_notice() -> None:
    """As where it did not load, so that nobody knows which layers held. What no plain user can have
    is no news of each run."""
    made = Report("./walk:env.py")
    quotas = {"layer": "user-quotas", "enforced": False, "detail": "shared"}
    for profile in ("strict", ""):
        made.confinement = Confinement.of("strict", {"profile": profile, "layers": [quotas]}, "")
        [line] = made.confinement.lines()
        assert line.startswith("confined by: strict")
        assert list(reports.workflow_commands(made)) == []
        assert made.confinement.document()["recorded"] is True
    for asked, profile, unrecorded in (
        *(("strict", "no-userns", ""), ("no-userns", "", ""), ("strict", "strict", "no kernel")),
    ):
        made.confinement = Confinement.of(asked, {"profile": profile, "layers": []}, unrecorded)
        assert len(list(reports.workflow_commands(made))) == 1


def test_findings_are_bounded() -> None:
    made = Report("./walk:env.py")
    for number in range(600):
        made.add(Finding("runs", "x" * 100_000, task="t" * 10_000, file="f" * 10_000, line=number))
    assert (len(made.findings), made.left_out) == (500, 100)
    assert max(len(one.message) + len(one.task) + len(one.file) for one in made.findings) < 2_000


def test_a_flood_of_notes_hides_no_error() -> None:
    made = Report("./walk:env.py")
    for number in range(10_000):
        made.add(Finding("source-dynamic", "calls eval", file="env.py", line=number))
    made.judged("seeding", ["step 3 differs"], "hub_env / 0")
    assert [one.id for one in made.failures(Severity.ERROR)] == ["seeding"]
    assert len(made.findings) < 1_000


def mixed() -> Report:
    made = Report("./walk:env.py")
    for check in ("card", "slow-steps", "licence", "denied-files", "runs", "seeding"):
        made.judged(check, [f"about {check}"], "a / 0")
    made.judged("loads", [])
    return made


def test_the_most_severe_stands_first_in_every_form() -> None:
    made = mixed()
    failures = made.failures(Severity.WARNING, ["runs"])
    order = ["runs", "seeding", "slow-steps", "denied-files", "card", "licence"]
    told = reports.document(made, failures)
    assert [one["check"] for one in told["findings"]] == order
    cases = [one.attrib["name"] for one in ElementTree.fromstring(reports.junit(made, failures))]
    assert cases == [*order, "loads"]
    [run] = json.loads(reports.sarif(made, failures))["runs"]
    assert [one["ruleId"] for one in run["results"]] == order
    lines = reports.workflow_commands(made)
    commands = [line.partition("title=envhub check%3A ")[2] for line in lines]
    assert [line.partition(" ")[0] for line in commands] == order
    rows = reports.summary(made, failures).splitlines()[-6:]
    assert [row.split("|")[2].strip() for row in rows] == order
    words = page(made, failures)
    assert sorted(order, key=lambda check: words.index(f"about {check}")) == order


@pytest.mark.parametrize(
    ("found", "allowed", "says"),
    [
        ([], [], "2 checks hold, 0 findings: passed"),
        (["card"], [], "2 checks hold, 1 finding, of which 1 fails it"),
        (["card", "runs"], [], "2 checks hold, 2 findings, of which 2 fail it"),
        (["card", "runs"], ["runs"], "2 checks hold, 2 findings, of which 1 fails it"),
        (["deadline"], [], "2 checks hold, 1 finding; not judged to its end"),
        (["deadline", "runs"], [], "2 checks hold, 2 findings, of which 2 fail it"),
    ],
)
def test_a_verdict_is_a_sentence(found: list[str], allowed: list[str], says: str) -> None:
    made = Report("./walk:env.py")
    for check in ("loads", "imports"):
        made.judged(check, [])
    for check in found:
        made.judged(check, ["it broke"])
    failures = made.failures(Severity.NOTE, allowed)
    assert made.verdict(failures) == says
    assert says in reports.summary(made, failures)
    assert says in page(made, failures)
    assert ('class="badge warning"' in page(made, failures)) == made.is_unjudged(failures)


@pytest.mark.parametrize(
    ("cause", "says"),
    [
        ("DependencyNotInstalled", "requirements.txt"),
        ("ModuleNotFoundError", "requirements.txt"),
        ("NamespaceNotFound", "Import the package that registers"),
        ("FileNotFoundError", "Put the file into"),
        ("out-of-memory", "--memory"),
        ("timeout", "--timeout"),
        ("returned", "Return what the spaces say"),
        ("ZeroDivisionError", CHECKS["runs"].cure),
        ("", CHECKS["runs"].cure),
    ],
)
def test_advice_follows_from_the_error(cause: str, says: str) -> None:
    """In every form that has advice; else it is that of the check."""
    made = Report("./walk:env.py")
    made.add(Finding("runs", "it broke", cause=cause))
    [told] = reports.document(made, [])["findings"]
    assert says in told["cure"]
    assert says in next(iter(reports.workflow_commands(made)))
    assert told["cure"] in unescape(page(made, []))


def test_what_was_not_judged_is_told_in_every_form() -> None:
    made = mixed()
    made.waiting = ["a / 0", "b / 1"]
    made.stopped(900, "a / 0")
    assert (made.findings[0].id, made.failures(Severity.ERROR)[0].id) == ("runs", "runs")
    [ended] = [one for one in made.findings if one.id == "deadline"]
    assert "ended after 15 min 0 s, at: a / 0. Not judged: requirements, " in ended.message
    assert ended.message.endswith("all of b / 1")
    told = reports.document(made, [])
    assert told["unjudged"]["tasks"] == ["a / 0", "b / 1"]
    assert not set(told["unjudged"]["checks"]) & {"runs", "card", "loads", "deadline"}
    root = ElementTree.fromstring(reports.junit(made, []))
    skipped = [one.attrib for one in root if one.find("skipped") is not None]
    assert {"classname": "b / 1", "name": "*"} in skipped
    assert int(root.attrib["skipped"]) == len(skipped) == len(made.unmade) + 2
    assert int(root.attrib["tests"]) == len(list(root))
    [run] = json.loads(reports.sarif(made, []))["runs"]
    assert run["invocations"] == [{"executionSuccessful": False}]

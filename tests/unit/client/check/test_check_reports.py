"""Reports of ``envhub check``: what a repository writes into them stays text in each form."""

from __future__ import annotations

import json
from xml.etree import ElementTree

import pytest

from envhub_sandbox.check import reports
from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.table import CHECKS, Severity
from envhub_sandbox.check.walls import walls
from envhub_worker.protocol.text import printable

_HOSTILE = (
    "x\n::error::forged",
    "x\r\n::add-mask::forged",
    "<script>alert(1)</script> | [a](javascript:b) ![i](http://example.com/x) `c`",
    "]]></failure></testcase><testcase name='forged'/>",
    "\x1b[2J\x00\ufffe\ud800 %0A::error::forged",
)


def report(text: str) -> Report:
    """One in which a repository chose every word that it can."""
    made = Report("./walk:env.py")
    made.add(Finding("runs", text, task=text, file=text, line=3))
    made.judged("loads", [])
    return made


@pytest.mark.parametrize("text", _HOSTILE)
def test_a_workflow_command_is_one_line(text: str) -> None:
    """And begins where it begins; the control is the text itself, which has a line of its own."""
    [line] = reports.workflow_commands(report(text))
    assert len(line.splitlines()) == 1
    assert line.startswith("::error file=")
    assert line.count("::") == 2 + text.replace("\r", "").count("::")
    head = line.split("title=")[0]
    assert "\n" not in head
    assert head.count("::") == 1


@pytest.mark.parametrize("text", _HOSTILE)
def test_a_summary_has_no_strangers_markup(text: str) -> None:
    """One row of four cells, in which nothing is a tag, a link or an image."""
    made = report(text)
    table = reports.summary(made, made.findings).splitlines()
    [row] = [line for line in table if line.startswith("| **fails**")]
    assert row.count("|") == 5
    assert not set("<>[]!`") & set(row)


@pytest.mark.parametrize("text", _HOSTILE)
def test_what_confined_it_is_text(text: str) -> None:
    """Of a server on another host: a line is one, a command is one, and a flood is cut."""
    made = Report("./walk:env.py")
    layers = [{"layer": text, "enforced": False, "detail": text}] * 1_000
    held = {"layer": "seccomp", "enforced": True, "detail": ""}
    provenance = {"profile": "container", "layers": [held, *layers]}
    made.walls = walls("strict", provenance, text * 1_000)
    lines = list(made.walls.lines())
    assert lines[0] == "profile container, within a container; strict was asked for"
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
    """As where it did not load, so that nobody knows which layers held."""
    made = Report("./walk:env.py")
    for profile in ("strict", ""):
        made.walls = walls("strict", {"profile": profile, "layers": []}, "")
        [line] = made.walls.lines()
        assert line.startswith("profile strict, as asked for")
        assert list(reports.workflow_commands(made)) == []
        assert made.walls.document()["recorded"] is True


@pytest.mark.parametrize("text", _HOSTILE)
def test_junit_is_well_formed(text: str) -> None:
    """Two cases, whatever the text."""
    made = report(text)
    suite = ElementTree.fromstring(reports.junit(made, made.findings))
    assert suite.attrib["tests"] == "2"
    assert suite.attrib["failures"] == "1"
    assert [case.attrib["name"] for case in suite] == ["runs", "loads"]
    [failure] = suite.findall("testcase/failure")
    assert failure.text


@pytest.mark.parametrize("text", _HOSTILE)
def test_sarif_is_data(text: str) -> None:
    """A result of a rule that is there, at a place that is a URI."""
    made = report(text)
    [run] = json.loads(reports.sarif(made, made.findings))["runs"]
    assert [rule["id"] for rule in run["tool"]["driver"]["rules"]] == list(CHECKS)
    [result] = run["results"]
    place = result["locations"][0]["physicalLocation"]
    assert place["artifactLocation"]["uri"].isascii()
    assert not set(" <>\n") & set(place["artifactLocation"]["uri"])
    assert place["region"] == {"startLine": 3}


def test_sarif_has_no_strangers_links() -> None:
    """Nor placeholders: what has a meaning in a message is escaped."""
    made = report("[Approve](https://example.com) {0} \\")
    [result] = json.loads(reports.sarif(made, made.findings))["runs"][0]["results"]
    assert "\\[Approve\\](" in result["message"]["text"]
    assert "{{0}} \\\\" in result["message"]["text"]


def test_a_summary_makes_no_links_of_names() -> None:
    """A host's name is one without any markup."""
    made = report("www.example.com/x __bold__")
    assert "www.example" not in reports.summary(made, made.findings)
    assert "__" not in reports.summary(made, made.findings)


def test_findings_are_bounded() -> None:
    """Neither their number nor their length is a repository's choice."""
    made = Report("./walk:env.py")
    for number in range(600):
        made.add(Finding("runs", "x" * 100_000, task="t" * 10_000, file="f" * 10_000, line=number))
    assert len(made.findings) == 500
    assert made.left_out == 100
    assert max(len(one.message) + len(one.task) + len(one.file) for one in made.findings) < 2_000


def test_a_flood_of_notes_hides_no_error() -> None:
    """What fails a repository is kept, however much was found in its source before."""
    made = Report("./walk:env.py")
    for number in range(10_000):
        made.add(Finding("source-dynamic", "calls eval", file="env.py", line=number))
    made.judged("seeding", ["step 3 differs"], "hub_env / 0")
    assert [one.id for one in made.failures(Severity.ERROR)] == ["seeding"]
    assert len(made.findings) < 1_000


def test_severities_are_ordered() -> None:
    """A note fails nothing but where notes are asked for."""
    assert Severity.ERROR.reaches(Severity.WARNING)
    assert not Severity.NOTE.reaches(Severity.WARNING)
    assert Severity.NOTE.reaches(Severity.NOTE)

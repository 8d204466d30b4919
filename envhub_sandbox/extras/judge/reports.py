"""Writes a report for other programs: JSON, JUnit's XML, SARIF, and GitHub's annotations.

Its texts are partly a stranger's: they arrive printable and bounded, and each format escapes its
special characters.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Sequence
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

from envhub_sandbox.extras.judge.checks import CHECKS, Severity
from envhub_sandbox.extras.judge.findings import Finding, Report

_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_GITHUB = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.NOTE: "notice"}
# characters that XML 1.0 cannot express
_NO_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def document(report: Report, failures: Sequence[Finding]) -> dict[str, Any]:
    """Returns the whole report as plain data."""
    return {
        "reference": report.reference,
        "commit": report.commit,
        "passed": not failures,
        "findings": [
            {
                **finding.document(),
                "cure": finding.cure,
                "task": finding.task or None,
                "fails": finding in failures,
            }
            for finding in report.findings
        ],
        "left_out": report.left_out,
        "unjudged": {"checks": report.unmade, "tasks": report.waiting},
        "held": [{"check": check, "task": task} for check, task in report.passed],
        "figures": report.figures,
        "confinement": None if report.confinement is None else report.confinement.document(),
        "provenance": report.provenance,
    }


def junit(report: Report, failures: Sequence[Finding]) -> str:
    """Returns a test case for each check of each task; harmless findings are its output."""
    return xml(suite(report, failures))


def xml(root: ElementTree.Element) -> str:
    """Returns a document as text."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def suite(report: Report, failures: Sequence[Finding]) -> ElementTree.Element:
    """Returns a report as a JUnit suite."""
    asked = dict.fromkeys(
        [*((finding.id, finding.task) for finding in report.findings), *report.passed]
    )
    failed = dict.fromkeys((finding.id, finding.task) for finding in failures)
    unjudged = [
        *((check, "") for check in report.unmade),
        *(("*", task) for task in report.waiting),
    ]
    root = ElementTree.Element(
        "testsuite",
        name=xml_text(report.reference),
        tests=str(len(asked) + len(unjudged)),
        failures=str(len(failed)),
        errors="0",
        skipped=str(len(unjudged)),
    )
    for check, task in asked:
        case = _case(root, check, task)
        findings = [
            finding for finding in report.findings if (finding.id, finding.task) == (check, task)
        ]
        text = "\n".join(finding.text for finding in findings)
        if (check, task) in failed:
            words = xml_text(CHECKS[check].sentence)
            ElementTree.SubElement(case, "failure", message=words).text = xml_text(text)
        elif findings:
            ElementTree.SubElement(case, "system-out").text = xml_text(text)
    for check, task in unjudged:
        ElementTree.SubElement(_case(root, check, task), "skipped", message="not judged")
    return root


def _case(suite: ElementTree.Element, check: str, task: str) -> ElementTree.Element:
    task_name = xml_text(task or "repository")
    return ElementTree.SubElement(suite, "testcase", classname=task_name, name=check)


def xml_text(text: str) -> str:
    """Replaces characters that XML cannot express."""
    return _NO_XML.sub("?", text)


def sarif(report: Report, failures: Sequence[Finding]) -> str:
    """Returns SARIF 2.1.0. A finding without a file is placed at the entry file's folder."""
    rules = [
        {
            "id": check.id,
            "shortDescription": {"text": check.sentence},
            "help": {"text": check.cure},
            "defaultConfiguration": {"level": check.severity.value},
        }
        for check in CHECKS.values()
    ]
    run = {
        "tool": {"driver": {"name": "envhub check", "rules": rules}},
        "results": [_result(finding, failures, report.folder) for finding in report.findings],
        "invocations": [{"executionSuccessful": not (report.unmade or report.waiting)}],
        "columnKind": "unicodeCodePoints",
    }
    return json.dumps({"$schema": _SCHEMA, "version": "2.1.0", "runs": [run]}, indent=2) + "\n"


def _result(finding: Finding, failures: Sequence[Finding], folder: str) -> dict[str, Any]:
    prefix = f"{finding.task}: " if finding.task else ""
    location: dict[str, Any] = {
        "artifactLocation": {"uri": quote(folder + (finding.file or "env.py"))}
    }
    if finding.line:
        location["region"] = {"startLine": finding.line}
    # SARIF has links and placeholders in texts
    plain = re.sub(r"([\\\[\]])", r"\\\1", f"{prefix}{finding.message}")
    return {
        "ruleId": finding.id,
        "level": finding.check.severity.value,
        "message": {"text": plain.replace("{", "{{").replace("}", "}}")},
        "locations": [{"physicalLocation": location}],
        "properties": {"fails": finding in failures},
    }


def workflow_commands(report: Report) -> Iterator[str]:
    """Yields GitHub's workflow commands, one a line: a stranger's text cannot begin another."""
    for finding in report.findings:
        location = f"file={_property(report.folder + finding.file)}," if finding.file else ""
        location += f"line={finding.line}," if finding.line else ""
        title = f"envhub check: {finding.id}" + (f" ({finding.task})" if finding.task else "")
        text = f"{finding.message}\n{finding.cure}"
        yield workflow_command(_GITHUB[finding.check.severity], title, text, location)
    if report.confinement is not None and report.confinement.is_partial:
        words = "\n".join(report.confinement.lines())
        yield workflow_command("notice", "envhub check: confinement", words)


def workflow_command(level: str, title: str, text: str, place: str = "") -> str:
    """Returns a workflow command; the properties in ``place`` must be escaped already."""
    return f"::{level} {place}title={_property(title)}::{_data(text)}"


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")


def summary(report: Report, failures: Collection[Finding]) -> str:
    """Returns a table for GitHub's step summary; escapes a stranger's text."""
    lines = [f"### envhub check: {report.verdict(failures)}", "", cell(report.reference), ""]
    if report.confinement is not None:
        lines += [*(f"- {cell(line)}" for line in report.confinement.lines()), ""]
    if report.findings:
        lines += ["| | check | task | finding |", "| --- | --- | --- | --- |"]
    for finding in report.findings:
        mark = "**fails**" if finding in failures else finding.check.severity.value
        lines.append(f"| {mark} | {finding.id} | {cell(finding.task)} | {cell(finding.text)} |")
    return "\n".join(lines) + "\n"


def cell(text: str) -> str:
    """Returns a cell of a Markdown table; special characters become numeric references."""
    return re.sub(
        r"[^a-zA-Z0-9 ,;=-]", lambda found: f"&#{ord(found[0])};", text.replace("\n", " ")
    )

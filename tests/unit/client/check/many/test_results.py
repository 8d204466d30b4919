"""What was judged is known again, and what is half there, changed or foreign is not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from xml.etree import ElementTree

import pytest

from envhub_sandbox.check import reports
from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.many import index, results
from envhub_sandbox.check.many.entries import ListEntry
from envhub_sandbox.check.many.results import (
    FolderError,
    ForeignResultError,
    Result,
    Results,
    Verdict,
    link,
)
from envhub_worker.protocol.text import printable
from tests.support.output.pages import HOSTILE, Page, results_of

_ONE = ListEntry("org/repo", "org/repo@main", 1)


def told(text: str = "it broke", *, fails: bool = True) -> dict[str, Any]:
    """What ``check --json`` prints."""
    report = Report("org/repo@abc", commit="abc")
    report.add(Finding("runs", text, task=text, file=text, line=3))
    report.add(Finding("card", text))
    report.judged("loads", [])
    document = reports.document(report, report.findings[:1] if fails else [])
    read: dict[str, Any] = json.loads(json.dumps(document))
    return read


def edit(file: Path, old: str, new: str) -> None:
    file.write_text(file.read_text().replace(old, new))


def keep(kept: Results, running: Path, document: dict[str, Any] | None = None) -> Result:
    page = running / "page.html"
    page.write_text("a page")
    return kept.keep(_ONE, document or told(), page, seconds=1.5, ended="2026-01-01T00:00:00+00:00")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "judged"


def test_a_report_is_read_as_it_was_written() -> None:
    for text in (*HOSTILE, ""):
        document = told(text)
        report, failures = reports.read_report(document)
        again = json.loads(json.dumps(reports.document(report, failures)))
        assert [one["check"] for one in again["findings"]] == ["runs", "card"]
        assert [one["fails"] for one in again["findings"]] == [True, False]
        assert again["held"] == document["held"]
        assert (again["passed"], again["commit"]) == (False, "abc")


def test_what_was_judged_is_known_again(folder: Path) -> None:
    with Results(folder, "as ever").held() as running:
        made = keep(Results(folder, "as ever"), running)
    assert (made.verdict, made.fails, made.found) == (
        Verdict.FAILED,
        (("runs", "it broke:3: it broke"),),
        {"error": 1, "note": 1},
    )
    assert Results(folder, "as ever").kept(_ONE) == made
    assert Results(folder, "otherwise").kept(_ONE) is None
    assert Results(folder, "as ever").kept(ListEntry("org/x", "org/x@main", 1)) is None
    Results(folder, "as ever").forget(_ONE)
    assert Results(folder, "as ever").kept(_ONE) is None


@pytest.mark.parametrize(
    "spoil",
    [
        lambda json_, page: json_.write_bytes(json_.read_bytes()[:-100]),
        lambda json_, page: json_.write_bytes(b""),
        lambda json_, page: json_.write_bytes(b"[" * 100_000),
        lambda json_, page: json_.write_text("[1]"),
        lambda json_, page: edit(json_, '"passed": false', '"passed": true'),
        lambda json_, page: edit(json_, '"runs"', '"nothing"'),
        lambda json_, page: edit(json_, '"loads"', '"nothing"'),
        lambda json_, page: edit(json_, '"checks": []', '"checks": ["nothing"]'),
        lambda json_, page: edit(json_, "1.5", "NaN"),
        lambda json_, page: edit(json_, "repo@main", "other@main"),
        lambda json_, page: (json_.unlink(), json_.symlink_to(page)),
        lambda json_, page: (json_.unlink(), json_.symlink_to("/nowhere")),
        lambda json_, page: (json_.unlink(), json_.mkdir()),
        lambda json_, page: (json_.unlink(), os.mkfifo(json_)),
        lambda json_, page: page.write_text("another"),
        lambda json_, page: page.unlink(),
    ],
)
def test_what_is_not_whole_is_absent(spoil: Any, folder: Path) -> None:
    """With a word; the control is the one before it was spoiled."""
    kept = Results(folder, "as ever")
    with kept.held() as running:
        keep(kept, running)
    assert kept.kept(_ONE) is not None
    spoil(folder / link(_ONE, "json"), folder / link(_ONE, "html"))
    with pytest.raises(ForeignResultError):
        kept.kept(_ONE)
    assert kept.report(_ONE) is None


def test_an_interrupted_writer_leaves_what_was_there(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a file is whole nobody sees it, and what is left of it is in nobody's way."""
    kept = Results(folder, "as ever")
    with kept.held() as running:
        made = keep(kept, running)
        with monkeypatch.context() as patched:
            patched.setattr(results.os, "replace", Mock(side_effect=OSError("no power")))
            with pytest.raises(OSError, match="no power"):
                keep(kept, running, told(fails=False))
        assert kept.kept(_ONE) == made
        assert keep(kept, running, told(fails=False)).verdict is Verdict.PASSED


@pytest.mark.parametrize("spoilt", [{"reference": 3}, {"findings": [{}]}, {"passed": True}])
def test_what_is_no_report_is_not_kept(spoilt: dict[str, Any], folder: Path) -> None:
    kept = Results(folder, "as ever")
    with kept.held() as running, pytest.raises(ForeignResultError):
        keep(kept, running, {**told(), **spoilt})
    assert kept.kept(_ONE) is None
    with pytest.raises(ForeignResultError, match="no page"):
        kept.keep(_ONE, told(), folder / "nowhere", seconds=1.5, ended="")
    assert kept.kept(_ONE) is None


def test_one_run_has_a_folder(folder: Path) -> None:
    """Another is told; after it, whatever ended it, what it was about is gone and results stay."""
    kept = Results(folder, "as ever")
    code = (
        "import sys, time; from pathlib import Path\n"
        "from envhub_sandbox.check.many.results import Results\n"
        "with Results(Path(sys.argv[1]), '').held() as running:\n"
        "    (running / 'half').touch()\n"
        "    print('held', flush=True)\n"
        "    time.sleep(600)\n"
    )
    command = [sys.executable, "-I", "-c", code, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout.readline() == b"held\n"
            with pytest.raises(FolderError, match="another run"), kept.held():
                pass
        finally:
            other.kill()
    assert (folder / ".running" / "half").exists()
    with kept.held() as running:
        assert list(running.iterdir()) == []
    assert not (folder / ".running").exists()


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    """Such as a project's, whose index.html would be overwritten."""
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(FolderError, match="other files"), Results(tmp_path, "").held():
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]


def shape(page: Page) -> list[tuple[str, tuple[tuple[str, str | None], ...]]]:
    """Its tags, but for where links lead, which is a name of ours."""
    return [
        (tag, tuple((name, "" if tag == "a" else value) for name, value in attributes))
        for tag, attributes in page.tags
    ]


@pytest.mark.parametrize("text", HOSTILE)
def test_an_index_has_the_tags_of_ours_alone(text: str) -> None:
    """The very same as with a harmless text, and the text is there to read.

    The control is a page that did not escape.
    """
    quiet = index.page(results_of("walk"))
    found = Page(index.page(results_of(text)))
    assert shape(found) == shape(Page(quiet))
    assert printable(text, 500)[:200] in found.text
    assert "script" not in found.names
    for tag, attributes in found.tags:
        for name, value in attributes if tag == "a" else ():
            assert (name, str(value).rpartition("/")[0]) == ("href", "reports")
    [policy] = [dict(attrs)["content"] for _, attrs in found.tags if "http-equiv" in dict(attrs)]
    assert str(policy).startswith("default-src 'none'")
    assert "script" not in str(policy)
    if "<" in text and set(text) != {"<"}:
        assert shape(Page(quiet.replace("walk", text))) != shape(Page(quiet))


def test_an_index_shows_first_what_fails() -> None:
    made = list(reversed(results_of("walk")))
    text = Page(index.page(made)).text
    words = ["failed", "not judged", "waiting", "passed"]
    body = text[text.rindex("judged\n") :] if "judged\n" in text else text
    assert sorted(words, key=body.rindex) == words
    document = index.index_document(made)
    assert [row["verdict"] for row in document["results"]] == words
    titles = [line.partition("::")[2].partition("%0A")[0] for line in index.workflow_commands(made)]
    assert [title.rpartition("::")[2] for title in titles] == words[:3]
    assert document["counts"] == dict.fromkeys(words, 1)


@pytest.mark.parametrize("text", HOSTILE)
def test_other_forms_are_well_formed_too(text: str) -> None:
    made = results_of(text)
    report, failures = reports.read_report(told(text))
    root = ElementTree.fromstring(index.junit(made, lambda _: (report, failures)))
    assert [one.attrib["errors"] for one in root] == ["0", "1", "1", "0"]
    assert root.attrib["errors"] == "2"
    assert {case.tag for one in root for case in one} == {"testcase"}
    commands = list(index.workflow_commands(made))
    assert len(commands) == 3
    assert all(len(line.splitlines()) == 1 and line.startswith("::error ") for line in commands)
    rows = index.summary(made).splitlines()[4:]
    assert len(rows) == 4
    assert all(row.count("|") == 4 and not set("<>[]!`") & set(row) for row in rows)
    json.dumps(index.index_document(made), allow_nan=False)


def test_an_index_is_bounded() -> None:
    listed = ListEntry("x" * 4_096, "y", 1)
    one = Result(listed=listed, verdict=Verdict.UNJUDGED, said="<" * 100_000, ended="z")
    assert len(index.page([one] * 200)) < 2_000_000

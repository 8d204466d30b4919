"""The page of a judgement: nothing of a stranger's is markup in it."""

from __future__ import annotations

from html.parser import HTMLParser

import pytest

from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.page import page
from envhub_worker.protocol.text import printable

_HOSTILE = (
    "<script>alert(1)</script>",
    "</title></style></td><img src=x onerror=alert(1)>",
    "\" onmouseover='alert(1)' x=\"",
    "&lt;script&gt;&#60;script&#62;",
    "<!-- --><svg/onload=alert(1)>]]>",
    "javascript:alert(1) http://example.com/",
    "\x1b[2J\x00\u202e\ud800\x85<b>\r\n<i>",
    "<" * 100_000,
)
_QUIET = "walk"
_OURS = frozenset(
    {
        *("html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "strong", "span"),
        *("table", "tr", "th", "td"),
    }
)


class _Read(HTMLParser):
    """A page as a browser takes it: its tags with their attributes, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, tuple[tuple[str, str | None], ...]]] = []
        self.words: list[str] = []
        self.odd: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, tuple(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def handle_comment(self, data: str) -> None:
        self.odd.append(data)

    def handle_pi(self, data: str) -> None:
        self.odd.append(data)


def report(text: str) -> Report:
    """One in which a repository chose every word that it can, and some that it cannot."""
    made = Report(text)
    made.add(Finding("runs", text, task=text, file=text, line=3))
    made.judged("rewards", [text], text)
    made.judged("loads", [], text)
    made.figures[text] = {"steps": 3.0, "step_mean_s": 0.001, "memory_bytes": 1e6}
    made.provenance = {
        "repository": text,
        "commit": text,
        "interpreter": {text: text},
        "packages": {text: [text]},
        "layers": [{"layer": text, "enforced": True, "detail": text}],
    }
    return made


@pytest.mark.parametrize("text", _HOSTILE)
def test_a_page_has_the_tags_of_ours_alone(text: str) -> None:
    """The very same as with a harmless text, attributes included; and the text is there to read.

    The control is the text itself: as markup it would be something else than text.
    """
    made, quiet = report(text), report(_QUIET)
    found = _Read(page(made, made.findings))
    assert found.tags == _Read(page(quiet, quiet.findings)).tags
    assert found.odd == []
    assert {tag for tag, _ in found.tags} <= _OURS
    assert printable(text, 1_000) in "".join(found.words)


def test_the_control_would_be_told() -> None:
    """A page that did not escape has other tags."""
    made = report(_QUIET)
    text = page(made, made.findings)
    assert _Read(text.replace(_QUIET, _HOSTILE[0])).tags != _Read(text).tags


def test_a_page_needs_and_runs_nothing() -> None:
    """No script, no link, no picture from elsewhere; and a browser is told so."""
    made = report("http://example.com/x.js")
    found = _Read(page(made, []))
    attributes = {name for _, attrs in found.tags for name, _ in attrs}
    assert attributes == {"lang", "charset", "http-equiv", "content", "name", "class"}
    [policy] = [dict(attrs)["content"] for _, attrs in found.tags if ("http-equiv" in dict(attrs))]
    assert policy is not None
    assert policy.startswith("default-src 'none'")
    assert "script" not in policy


def test_a_page_is_bounded() -> None:
    """However much a repository says."""
    made = report(_QUIET)
    for number in range(5_000):
        made.judged("runs", ["x" * 100_000], f"{number}")
        made.judged("loads", [], "t" * 1_000)
    made.provenance = {"packages": {str(number): "x" * 1_000 for number in range(10_000)}}
    assert len(page(made, made.findings)) < 2_000_000

"""The page of a judgement: nothing of a stranger's is markup in it."""

import base64
import hashlib
import re

import pytest

from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.page import page
from envhub_sandbox.extras.judge.play.film import Film, Play
from envhub_sandbox.vector.pictures import png
from envhub_worker.protocol.text import printable
from tests.support.output.pages import FRAME, HOSTILE, Page, report_of

_QUIET = "walk"
_DRAWN = frozenset({"svg", "rect", "line", "polyline", "polygon", "text"})
_OURS = _DRAWN | {
    *("html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "strong", "span"),
    *("table", "tr", "th", "td", "div", "ul", "li", "code", "section", "h3", "dl", "dt", "dd"),
    *("figure", "figcaption", "video", "img", "details", "summary"),
}


@pytest.mark.parametrize("text", HOSTILE)
def test_a_page_has_the_tags_of_ours_alone(text: str) -> None:
    """The very same as with a harmless text, attributes included; and the text is there to read.
    The control is a page that did not escape: it has other tags."""
    made, quiet = report_of(text), report_of(_QUIET)
    found, harmless = Page(page(made, made.findings)), page(quiet, quiet.findings)
    assert found.tags == Page(harmless).tags
    assert found.names <= _OURS, "not even a comment"
    assert printable(text, 1_000) in found.text
    if text == HOSTILE[2]:
        assert Page(harmless.replace(_QUIET, text)).tags != Page(harmless).tags


def test_a_page_needs_and_runs_nothing() -> None:
    made = report_of("http://example.com/x.js")
    found = Page(page(made, []))
    attributes = {name for tag, attrs in found.tags for name, _ in attrs if tag not in _DRAWN}
    assert attributes == {
        *("lang", "charset", "http-equiv", "content", "name", "class", "alt", "src"),
        "data-head",
        *("controls", "loop", "muted", "playsinline"),
    }
    for _, attrs in found.tags:
        source = dict(attrs).get("src")
        assert source is None or source.startswith(("data:image/png;base64,", "data:video/mp4;"))
    [policy] = [dict(attrs)["content"] for _, attrs in found.tags if ("http-equiv" in dict(attrs))]
    assert {"default-src 'none'", "base-uri 'none'", "form-action 'none'"} < set(policy.split("; "))
    assert "script" not in policy
    assert "unsafe" not in policy, "nor does it look as a stranger's style says"
    [style] = re.findall("<style>(.*)</style>", page(made, []), re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy


def test_what_was_played_can_be_seen() -> None:
    made = report_of(_QUIET)
    made.figures["a / 0"] = {"steps": 200.0, "step_mean_s": 0.0123, "memory_bytes": 3.0 * 2**30}
    found = Page(page(made, []))
    tags = [tag for tag, _ in found.tags]
    assert (tags.count("img"), tags.count("video"), tags.count("svg")) == (2, 1, 4)
    shown = [dict(attrs)["src"] for tag, attrs in found.tags if tag == "img"]
    assert shown == [f"data:image/png;base64,{base64.b64encode(png(FRAME)).decode()}"] * 2
    told = ("Return, component 1 of 2, per episode", "mean 1", "Length of episodes", "Memory")
    for words in (*told, "12.3 ms", "3 GiB"):
        assert words in found.text
    [plots] = re.findall(r"\.plots \{([^}]*)\}", page(made, []))
    assert "auto-fill" in plots, "a lone plot is as large as one of several"


def test_pictures_are_no_reason_for_a_page_of_any_size() -> None:
    made = report_of(_QUIET)
    for number in range(30):
        film = Film((b"s" * (1 << 20),), b"v" * (2 << 20), frames=9, fps=3.0)
        made.plays[f"task {number}"] = Play(film=film)
    text = page(made, [])
    assert len(text) < 18 << 20
    assert 2 < text.count("<video") < 6
    assert "this page would be too large" in text


def test_a_page_is_bounded() -> None:
    made = report_of(_QUIET)
    for number in range(5_000):
        made.judged("runs", ["x" * 100_000], f"{number}")
        made.judged("loads", [], "t" * 1_000)
    made.provenance = {"packages": {str(number): "x" * 1_000 for number in range(10_000)}}
    made.plays = {str(number): Play() for number in range(50)}
    words = page(made, made.findings)
    assert (words.count("<section"), "10 more have a line below" in words) == (40, True)
    assert len(words) < 2_000_000


@pytest.mark.parametrize(
    ("film", "says", "says_not"),
    [
        (Film((png(FRAME),), b"a video", 9, 3.0, "it stopped"), "The film ends early", "No film"),
        (Film((png(FRAME),), frames=9, lacks="it stopped"), "No film: it stopped", "ends early"),
        (Film(lacks="it stopped"), "No picture: it stopped", "No film"),
        (Film((png(FRAME),), b"a video", 1, 3.0), "1 frame, 3 a second", "No film"),
    ],
)
def test_a_page_says_no_film_only_where_there_is_none(film: Film, says: str, says_not: str) -> None:
    made = Report("./walk:env.py")
    made.plays["a / 0"] = Play(film=film)
    words = Page(page(made, [])).text
    assert says in words
    assert says_not not in words

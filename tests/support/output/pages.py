"""A page as a parser takes it, and what pages are made of where a stranger chose every word."""

from html.parser import HTMLParser

import numpy as np

from envhub_sandbox.extras.judge.findings import Finding, Report
from envhub_sandbox.extras.judge.play.film import Film, Play
from envhub_sandbox.play.confinement import Confinement
from envhub_sandbox.play.episodes import Episode
from envhub_sandbox.vector.pictures import png

FRAME = np.full((4, 6, 3), 200, np.uint8)
HOSTILE = (
    "x\n::error::forged",
    "x\r\n::add-mask::forged",
    "<script>alert(1)</script> | [a](javascript:b) ![i](http://example.com/x) `c`",
    "</title></style></td></a><img src=x onerror=alert(1)>",
    "]]></failure></error></testcase><testcase name='forged'/>",
    "\" onmouseover='alert(1)' x=\"",
    "&lt;script&gt;&#60;script&#62;",
    "<!-- --><svg/onload=alert(1)>]]>",
    "javascript:alert(1) http://example.com/",
    "\x1b[2J\x00\ufffe\u202e\ud800\x85<b>\r\n<i> %0A::error::forged",
    "<" * 100_000,
)
"""What a repository may write into a report, to be more than text there."""


class Page(HTMLParser):
    """Its tags with their attributes, and its text."""

    def __init__(self, source: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, tuple[tuple[str, str | None], ...]]] = []
        self.text = ""
        self.feed(source)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, tuple(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def handle_comment(self, data: str) -> None:
        self.tags.append(("!", ((data, None),)))

    handle_pi = handle_comment

    @property
    def names(self) -> set[str]:
        return {name for name, _ in self.tags}


def report_of(text: str) -> Report:
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
        "installed": {text: text},
        "files": {text: text},
        "layers": [{"layer": text, "enforced": True, "detail": text}],
    }
    made.asked = {"sandbox": text}
    missing = {"layer": text, "enforced": False, "detail": text}
    made.confinement = Confinement.of("strict", {"profile": "no-userns", "layers": [missing]}, text)
    film = Film((png(FRAME), png(FRAME)), b"a video", frames=2, fps=25.0, lacks=text)
    made.plays[text] = Play({"observations": text}, memory=[1 << 20, 2 << 20], film=film)
    made.plays[text].step_s = [0.001, 0.002]
    made.plays[text].episodes = [
        Episode(sub_env=0, returns=(total, 0.0), length=3, terminated=True, success=None)
        for total in (1.0, float("inf"))
    ]
    return made

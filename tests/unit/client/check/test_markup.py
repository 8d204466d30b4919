"""Whatever a stranger says is text on a page, and the page's policy forbids all else."""

from __future__ import annotations

import base64
import hashlib
import re
from html.parser import HTMLParser

import pytest

from envhub_sandbox.check import markup

_HOSTILE = "<script>alert(1)</script>\"'&\x1b[2J\u202e"


class Tags(HTMLParser):
    """The names of all tags and attributes of a page, and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags, self.names, self.data = set[str](), set[str](), ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """One that begins."""
        self.tags.add(tag)
        self.names.update(name for name, _ in attrs)

    def handle_data(self, data: str) -> None:
        """What is between."""
        self.data += data


@pytest.mark.parametrize("limit", [10, 1_000])
def test_text_has_no_meaning_for_html(limit: int) -> None:
    made = markup.text(_HOSTILE, limit)
    read = Tags(f'<p title="{made}">{made}</p>')
    assert (read.tags, read.names) == ({"p"}, {"title"})
    assert not {"\x1b", "\u202e", "<", '"', "'"} & set(made)


def test_a_page_runs_nothing() -> None:
    """Its own style is the only one that is permitted, by its hash."""
    page = markup.markup_page(_HOSTILE, ["<p>ours</p>"])
    read = Tags(page)
    assert "script" not in read.tags
    assert {name for name in read.names if name.startswith("on")} == set()
    [style] = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"default-src 'none'; style-src 'sha256-{digest}'" in page


def test_parts_of_a_page() -> None:
    """Facts, what is folded, and tables, in which each cell has the head of its column."""
    made = "".join([*markup.facts([(_HOSTILE, 3)]), *markup.folded(_HOSTILE, ["<b>in</b>"])])
    assert Tags(made).tags == {"dl", "dt", "dd", "details", "summary", "b"}
    table = "\n".join(markup.table(["A", _HOSTILE], [("<i>1</i>", "2")]))
    assert table.count("data-head=") == 2
    assert Tags(table).tags == {"div", "table", "tr", "th", "td", "i"}
    assert markup.data("image/png", b"\0") == "data:image/png;base64,AA=="


def test_a_table_ends_where_a_browser_would_not() -> None:
    made = list(markup.table(["A"], [("x",)] * 2_003))
    assert made[-1] == "<p>3 more are left out.</p>"
    assert sum(row.startswith("<tr><td") for row in made) == 2_000

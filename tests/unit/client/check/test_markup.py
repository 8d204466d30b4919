"""Whatever a stranger says is text on a page, and the page's policy forbids all else."""

from __future__ import annotations

import pytest

from envhub_sandbox.check import markup
from tests.support.output.pages import Page

_HOSTILE = "<script>alert(1)</script>\"'&\x1b[2J\u202e"


@pytest.mark.parametrize("limit", [10, 1_000])
def test_text_has_no_meaning_for_html(limit: int) -> None:
    """Between tags and in an attribute; and no terminal obeys it."""
    made = markup.text(_HOSTILE, limit)
    [(tag, attributes)] = Page(f'<p title="{made}">{made}</p>').tags
    assert (tag, [name for name, _ in attributes]) == ("p", ["title"])
    assert not {"\x1b", "\u202e", "<", '"', "'"} & set(made)


def test_parts_of_a_page() -> None:
    """Facts, what is folded, and tables, in which each cell has the head of its column."""
    made = "".join([*markup.facts([(_HOSTILE, 3)]), *markup.folded(_HOSTILE, ["<b>in</b>"])])
    assert Page(made).names == {"dl", "dt", "dd", "details", "summary", "b"}
    table = "\n".join(markup.table(["A", _HOSTILE], [("<i>1</i>", "2")]))
    assert table.count("data-head=") == 2
    assert Page(table).names == {"div", "table", "tr", "th", "td", "i"}
    assert markup.data("image/png", b"\0") == "data:image/png;base64,AA=="


def test_a_table_ends_where_a_browser_would_not() -> None:
    made = list(markup.table(["A"], [("x",)] * 2_003))
    assert made[-1] == "<p>3 more are left out.</p>"
    assert sum(row.startswith("<tr><td") for row in made) == 2_000

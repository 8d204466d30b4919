"""What a repository is called, and what its files are, ends up in a page: as text."""

from __future__ import annotations

import html
from pathlib import Path

import pytest

from tests.support.command_line import envhub
from tests.support.output.pages import Page

# a page is made of text by the same code, whoever runs it
pytestmark = pytest.mark.same_for("users")

_SCRIPT = "<script>alert(1)<!--"
_IMAGE = "<img src=x onerror='alert(1)'>.py"


def test_names_of_a_repository_are_no_markup(tmp_path: Path) -> None:
    """In the index of a list, where it says what could not be judged, and why.

    The control is the page as it would be without what escapes: there, both are tags.
    """
    folder, out = tmp_path / _SCRIPT, tmp_path / "out"
    folder.mkdir()
    (folder / _IMAGE).touch()
    (tmp_path / "list").write_text(f"{folder}\n")
    done = envhub("check", "--all", tmp_path / "list", "--output", out)
    assert done.returncode == 10, done.stderr
    source = (out / "index.html").read_text()
    page, unescaped = Page(source), Page(html.unescape(source))
    assert _SCRIPT in page.text
    assert _IMAGE in page.text, "a stranger's words have come that far"
    assert {"script", "img", "!"} & page.names == set()
    assert "script" in unescaped.names
    assert "img" in Page(html.unescape(source).replace(_SCRIPT, "")).names
    assert [path.name for path in (out / "reports").iterdir()] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([_SCRIPT, "list", "out"])

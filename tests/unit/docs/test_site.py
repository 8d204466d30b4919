"""The documents' site loads nothing from elsewhere: what CI asks of it would find it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.same_for("users", "versions")

_PAGE = "<head><meta http-equiv='Content-Security-Policy' content=\"default-src 'self'\">%s</head>"


@pytest.fixture(scope="module")
def loads(checkout: Path) -> Any:
    spec = importlib.util.spec_from_file_location("loads", checkout / ".ci" / "loads.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", _PAGE % '<script src="https://cdn.example/x.js"></script>'),
        ("a.html", _PAGE % '<link rel="stylesheet" href="//cdn.example/x.css">'),
        ("a.html", _PAGE % '<img srcset="x.png, https://cdn.example/y.png 2x">'),
        ("a.html", _PAGE % "<style>@import 'https://cdn.example/x.css'</style>"),
        ("a.html", _PAGE % '<p style="background: url(https://cdn.example/x.png)">'),
        ("a.html", _PAGE % "<script>fetch('https://cdn.example/x')</script>"),
        ("a.html", "<head></head>"),
        ("a.css", "p { background: url('//cdn.example/x.png') }"),
        ("a.js", 'import("https://cdn.example/x.js")'),
    ],
)
def test_what_a_page_loads_from_elsewhere_is_found(
    loads: Any, tmp_path: Path, name: str, text: str
) -> None:
    """Each way to load something, and a page that does not forbid it.

    The site's own files, a link that a reader follows, and names of XML's vocabularies are none.
    """
    own = '<script src="../x.js"></script><a href="https://example.com/">there</a>'
    (tmp_path / "own.html").write_text(_PAGE % own)
    (tmp_path / "own.js").write_text('of("http://www.w3.org/2000/svg") // see https://x.example')
    (tmp_path / name).write_text(text)
    [line] = loads.foreign(tmp_path)
    assert line.startswith(f"{name}: ")

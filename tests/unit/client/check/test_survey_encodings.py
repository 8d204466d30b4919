"""What is read of a Python file is what Python makes of its bytes, or the file is reported."""

from __future__ import annotations

import ast
import codecs
import importlib
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envhub_sandbox.check.checks import Severity
from envhub_sandbox.check.static import survey
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.hub.sources import parser, parsing
from tests.support.repositories import write_repository

_PIECES = (
    *(b"\n", b"\r", b"\r\n", b"\f", b"\v", b"\t", b" ", b"#", b"\\\n", b"\0", b"\x1a", b"'''"),
    *(b"import os\n", b"x = 1\n", b"# caf\xc3\xa9\n", b"# \xff\n", b"x = '\xe9'\n"),
    b"#!/bin/python\n",
    *(b"#\\u000aimport os\n", b"# +AAo-import os\n", b"+AGkAbQBwAG8AcgB0- os\n", b"pass"),
    *("\u00e9 = '\u00a5'\n".encode(), "import \U0001d428\U0001d42c\n".encode()),
    *(b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff", b"# coding: \xff\n", b"coding: utf-7\n"),
    *(b"# CODING: utf-7\n", b"# coding: x coding: utf-7\n", b"# coding:, coding:utf-7\n"),
)
_NAMES = st.sampled_from(
    (
        *("utf-8", "utf8", "UTF-8", "utf_8_sig", "utf-8-unix", "u8", "ascii", "us-ascii", "646"),
        *("latin-1", "iso-8859-15", "cp037", "shift_jis", "big5", "utf-7", "utf-16", "utf-16-le"),
        *("utf-32", "unicode_escape", "raw_unicode_escape", "rot13", "hex", "idna", "punycode"),
        *("mbcs", "undefined", "charmap", "no_such_codec", "utf-8\\u000a", "utf8-7", "utf-8.7"),
    )
)
_COOKIES = st.builds(
    lambda lead, between, name: f"{lead}coding{between}{name} -*-\n".encode(),
    st.sampled_from(("# -*- ", "#", "\t\f # ", "#en", "x # ")),
    st.sampled_from((":", "=", ": ", "=\t", " :", ":  ")),
    _NAMES,
)
_SOURCES = st.lists(st.one_of(_COOKIES, st.sampled_from(_PIECES)), max_size=7).map(b"".join)


def tree(source: bytes | str) -> str | None:
    """What Python makes of it, if it takes it."""
    try:
        return ast.dump(compile(source, "file", "exec", ast.PyCF_ONLY_AST, dont_inherit=True))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None


@settings(max_examples=300, deadline=None)
@given(_SOURCES)
def test_what_is_read_is_what_python_makes_of_the_bytes(source: bytes) -> None:
    """The same tree, of the bytes and of the text that is searched; or its encoding is reported."""
    python = tree(source)
    described = parser.described(source)
    if python is None or (described is not None and "encoding" in described):
        return
    read = {name for level, _, names, *_ in described["imports"] if level < 0 for name in names}
    nodes = ast.walk(ast.parse(source))
    assert read == {
        one.name for node in nodes if isinstance(node, ast.Import) for one in node.names
    }
    assert tree(source.decode("utf-8-sig")) == python


def evil(name: str) -> codecs.CodecInfo | None:
    """A codec of the repository's own, which makes of anything what it likes."""
    if name != "evil":
        return None
    return codecs.CodecInfo(codecs.utf_8_encode, lambda *_: ("import os\n", 0), name="evil")


_RUNS = {
    "an escape in a comment": b"# coding: unicode_escape\n# \\u000aimport os\n",
    "in the second line": b"#!/bin/sh\n# vim: fileencoding=raw_unicode_escape\n#\\u000aimport os",
    "behind a return": b"\r# coding: utf-7\n+AGkAbQBwAG8AcgB0- os\n",
    "behind a form feed": b"\f# coding: utf-7\n+AGkAbQBwAG8AcgB0- os\n",
    "behind bytes that are no text": b"# \xff\n# coding: unicode_escape\n# \\u000aimport os\n",
    "a backslash that is half a letter": b"# coding: shift_jis\nx = '\x95\\'; import os #'\n",
    "a codec of its own": b"# coding: evil\npass\n",
}


@pytest.mark.parametrize("case", _RUNS)
def test_code_in_another_encoding_is_reported(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each imports a module that a reader does not see; the import itself is the control."""
    codecs.register(evil)
    try:
        folder = write_repository(tmp_path / "r", "def make_env(): pass", README__md="", LICENSE="")
        (folder / "odd.py").write_bytes(_RUNS[case])
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, "odd", raising=False)
        assert hasattr(importlib.import_module("odd"), "os")
    finally:
        codecs.unregister(evil)
        sys.modules.pop("odd", None)
    snapshot = local(folder)
    told = survey(snapshot, parsing.read(snapshot)).findings
    severities = {one.id: one.check.severity for one in told if one.file == "odd.py"}
    assert severities["source-encoding"] is Severity.ERROR


@pytest.mark.parametrize(
    "source",
    [
        b"\xef\xbb\xbfimport os",
        b"# -*- coding: utf-8 -*-\nimport os",
        b"# coding: UTF8\r\nimport os",
        b"# coding: us-ascii\rimport os",
        b"x = 1\n# coding: utf-7\nimport os",
        "import \U0001d428\U0001d42c".encode(),
        b"\fimport os\f\n\f",
    ],
)
def test_what_is_utf_8_is_read(source: bytes) -> None:
    """However it says so, wherever its lines end, and by the names that Python makes of letters."""
    [one] = parsing.parsed({"odd.py": source})["odd.py"].imports  # type: ignore[union-attr]
    assert one.names == ("os",)

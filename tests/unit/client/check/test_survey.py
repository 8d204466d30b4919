"""What a repository's files show: nothing is run, and what cannot be read is said."""

import ast
import codecs
import importlib
import io
import pickle
import sys
import zipfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.findings import Finding
from envhub_sandbox.extras.judge.static import static
from envhub_sandbox.extras.sources import parser, parsing
from envhub_sandbox.hub.listing import FileRecord, Snapshot
from envhub_sandbox.hub.snapshot import local
from tests.support import inside
from tests.support.repositories import write_repository

_ENTRY = "def make_env(n_envs=1, use_async_envs=False): pass"


def zipped(*names: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(name, b"")
    return file.getvalue()


def repository(folder: Path, name: str, data: bytes | str) -> Path:
    write_repository(folder, _ENTRY, README__md="# x", LICENSE="MIT")
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
    return folder


def from_the_hub(folder: Path) -> Snapshot:
    """A folder as a snapshot of the Hub would have it, where nothing is left out."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    records = [
        FileRecord(str(path.relative_to(folder)), path.stat().st_size, "sha256:" + "0" * 64)
        for path in files
    ]
    return Snapshot("org/repo", "model", "0" * 40, "env.py", folder, tuple(records))


def surveyed(snapshot: Snapshot) -> list[Finding]:
    """What ``static`` finds, but for what the repository declares."""
    return [one for one in static(snapshot).findings if one.id != "requirements"]


def found(folder: Path, data: bytes | str, name: str = "odd.py") -> list[tuple[str, int]]:
    repository(folder, name, data)
    return [(one.id, one.line) for one in surveyed(local(folder)) if one.file == name]


def of_each(folder: Path, texts: list[str]) -> dict[str, set[tuple[str, int]]]:
    for number, text in enumerate(texts):
        repository(folder, f"odd{number}.py", text)
    told = surveyed(local(folder))
    return {
        text: {(one.id, one.line) for one in told if one.file == f"odd{number}.py"}
        for number, text in enumerate(texts)
    }


_WORTH_A_LOOK = [
    ("from urllib import request", "source-network"),
    ("import asyncio as a; a.open_connection('x', 1)", "source-network"),
    ("import subprocess", "source-process"),
    ("import os as harmless; harmless.system('x')", "source-process"),
    ("from os import system as s; s('x')", "source-process"),
    ("import os; run = os.popen", "source-process"),
    ("import os; getattr(os, 'system')('x')", "source-process"),
    ("import posix", "source-process"),
    ("from os import *; popen('x')", "source-process"),
    ("import os; q = os; q.popen('x')", "source-process"),
    ("import os; p, q = 1, os; (r := q).popen('x')", "source-process"),
    ("import os; f = lambda o=os: o.popen('x')", "source-process"),
    ("import os; x.of = {'a': os}; x.of['a'].popen('x')", "source-process"),
    ("import os; [o.popen('x') for o in [os]]", "source-process"),
    ("import os; import math as os; os.popen('x')", "source-process"),
    ("from helper import os; os.popen('x')", "source-process"),
    ("from helper import os as o; getattr(o, 'popen')('x')", "source-process"),
    ("import sys; sys.modules['os'].popen('x')", "source-process"),
    ("import sys; q = sys.modules.get('posix'); q.system('x')", "source-process"),
    ("import os; globals()['os'].popen('x')", "source-process"),
    ("import operator, os; operator.methodcaller('popen', 'x')(os)", "source-process"),
    ("import random; random._os.popen('x')", "source-process"),
    ("import logging; logging.os.popen('x')", "source-process"),
    (f"{'.'.join(['y' * 190] * 6)}.os.popen('x')", "source-process"),
    ("from os import popen as p", "source-process"),
    ("import webbrowser", "source-process"),
    ("import multiprocessing.util as u; u.spawnv_passfds(a, b, c)", "source-process"),
    ("loop.subprocess_shell(x, 'x')", "source-process"),
    ("import _socket", "source-network"),
    ("f().create_connection(x, 'x', 1)", "source-network"),
    ("import logging.handlers as h; h.HTTPHandler('x', 'x')", "source-network"),
    ("import os; vars(os)[name]('x')", "source-dynamic"),
    ("import os; os.__dict__[name]('x')", "source-dynamic"),
    ("import os; q = os; getattr(q, name)('x')", "source-dynamic"),
    ("import os; os.__getattribute__(name)('x')", "source-dynamic"),
    ("e = eval; e('1')", "source-dynamic"),
    ("list(map(eval, ['1']))", "source-dynamic"),
    ("__builtins__['eval']('1')", "source-dynamic"),
    ("f.__globals__['x']", "source-dynamic"),
    ("import pydoc; pydoc.importfile('x')", "source-dynamic"),
    ("from pkgutil import resolve_name as r; r(x)", "source-dynamic"),
    ("import logging.config as c; c.dictConfig({'()': x})", "source-dynamic"),
    ("from logging.config import dictConfig", "source-dynamic"),
    ("import _pickle", "source-pickle"),
    ("import numpy as np; np.load(x, None, True)", "source-pickle"),
    ("import numpy as np; np.load(x, **{'allow_pickle': 1})", "source-pickle"),
    ("import yaml; yaml.unsafe_load(x)", "source-pickle"),
    ("import yaml; yaml.load(x)", "source-pickle"),
    ("import yaml; yaml.load(x, Loader=yaml.Loader)", "source-pickle"),
    ("from yaml.loader import UnsafeLoader", "source-pickle"),
    ("import pandas as pd; pd.io.pickle.read_pickle(x)", "source-pickle"),
    ("import numpy as np; np.ctypeslib.load_library(x, y)", "source-native"),
    ("import os; getattr(os, 'sys' + 'tem')('x')", "source-dynamic"),
    ("\uff45\uff56\uff41\uff4c('1')", "source-dynamic"),
    ("import importlib; importlib.import_module(x)", "source-dynamic"),
    ("import builtins", "source-dynamic"),
    ("import zipimport", "source-dynamic"),
    ("import importlib.machinery as m; m.SourceFileLoader('x', 'x.txt')", "source-dynamic"),
    ("import codecs; codecs.register(x)", "source-dynamic"),
    ("import torch; torch.load('x')", "source-pickle"),
    ("import numpy as np; np.load('x', allow_pickle=True)", "source-pickle"),
    ("import ctypes", "source-native"),
    ("open('/etc/passwd')", "source-outside"),
    ("open('~/.ssh/id_rsa')", "source-outside"),
    ("x['HF_TOKEN']", "source-outside"),
    ("from pathlib import Path; Path.home()", "source-outside"),
    ("x = '" + "QUJD" * 300 + "'", "source-obscure"),
    ("x = 1" + " " * 3_000 + "; y = 2", "source-obscure"),
    ("x = 'a\u202eb'", "source-hidden"),
    ("# \u200b", "source-hidden"),
    ("\u3164 = 1", "source-hidden"),
    ("s\u0443stem = 1", "source-hidden"),
    ("x = 1\ry = 2", "source-hidden"),
    ("# \x1b[8m", "source-hidden"),
]


def test_what_is_worth_a_look_is_found(tmp_path: Path) -> None:
    """Each by its check alone, in its line; the line before is the control."""
    told = of_each(tmp_path / "r", [f"x = None\n{text}" for text, _ in _WORTH_A_LOOK])
    assert told == {f"x = None\n{text}": {(check, 2)} for text, check in _WORTH_A_LOOK}


_HONEST = [
    "import os, re, math; re.compile('x'); model.compile(); os.path.join('a', 'b')",
    "def f(eval=False, exec=None): return eval if exec else None",
    "import numpy as np; np.load('x'); np.load('y', allow_pickle=False)",
    "import torch; getattr(torch, name); getattr(self, 'system')",
    "from . import subprocess",
    '"""Reads /etc, and ~/.ssh, and so on."""',
    "x = 'na\u00efve \u0441\u043b\u043e\u0432\u043e \u5f3a\u5316'\r\ny = 1\r\n",
    "import os; path = os.path; getattr(os, 'path'); vars(self)[name]",
    "from os import *; path.join(name); from re import compile; compile('x')",
    "def f(compile=None): scan = compile or g; scan()",
    "self.config.listen(); self.profile.run(); self.loader.Loader()",
    "self.create_server(); evaluate = self.eval; evaluate(); map(self.compile, x)",
    "import yaml; yaml.load(x, yaml.SafeLoader); yaml.safe_load(x); yaml.load(x, Loader=y)",
    "import numpy as np; np.load(x, 'r', False); np.save(x, y, allow_pickle=True)",
    "import sys; sys.modules[__name__]; from operator import attrgetter; attrgetter('x')(y)",
    "import os; getattr(os, 0x" + "f" * 900 + ")",  # which Python refuses to write out
]


def test_honest_code_is_not_named(tmp_path: Path) -> None:
    assert {text: told for text, told in of_each(tmp_path / "r", _HONEST).items() if told} == {}


_KINDS = [
    ("fast.so", b"", "machine code", "source-native"),
    ("weights.npz", b"\x7fELF\x02", "machine code", "source-native"),
    ("a.txt", b"MZ\0\0", "machine code", "source-native"),
    ("env.cpython-311.pyc", b"\xa7\r\r\n\0\0", "compiled Python", "source-compiled"),
    ("__pycache__/env.pyc", b"MZ", "compiled Python", "source-compiled"),
    ("policy.pt", b"PK\x03\x04", "pickle", "source-pickle"),
    ("data.bin", pickle.dumps({"a": [1]}), "pickle", "source-pickle"),
    ("more.zip", b"PK\x03\x04", "archive", "source-unread"),
    ("more.dat", b"\x1f\x8b\x08", "archive", "source-unread"),
    ("icon.png", b"\x89PNG\r\n\x1a\n\0" + zipped("a.py"), "archive", "source-unread"),
    ("notes.txt", b"a\n" * 9_000 + zipped("a.txt"), "archive", "source-unread"),
    ("arrays.npz", zipped("a.npy", "b.npy"), "binary", ""),
    ("arrays.npz", zipped("a.npy", "b.pyc", "c.npy"), "archive", "source-unread"),
    ("arrays.npz", zipped(*map(str, range(2_000))), "archive", "source-unread"),
    (
        "mesh.stl",
        b"version https://git-lfs.github.com/spec/v1\n",
        "LFS pointer",
        "source-unread",
    ),
    ("weights.npz", b"PK\x03\x04\0", "binary", ""),
    ("frame.png", b"\x89PNG\r\n\x1a\n\0", "binary", ""),
    ("notes.txt", "\u5f3a\u5316 \u5b66\u4e60".encode(), "text", ""),
    ("long.txt", ("\u5f3a" * 5_000).encode(), "text", ""),
    ("turned.md", "a\u2066b".encode(), "text", "source-hidden"),
    ("mixed.md", "p\u0430ss".encode(), "text", ""),
    ("m\u0430th.txt", b"a", "text", "source-hidden"),
    ("a.md", b"\xff\xfe", "binary", ""),
    ("a.md", b"a\0b", "binary", ""),
]


def test_files_are_told_by_their_beginnings_and_ends(tmp_path: Path) -> None:
    """Whatever they are called, but what Python runs by its name; nothing opens them further."""
    for number, (name, data, *_) in enumerate(_KINDS):
        repository(tmp_path / "r", f"{number}/{name}", data)
    told = static(from_the_hub(tmp_path / "r"))
    kinds = {one.record.path: one.kind for one in told.files}
    for number, (name, _, kind, check) in enumerate(_KINDS):
        path = f"{number}/{name}"
        assert kinds[path] == kind, path
        checks = [one.id for one in told.findings if one.file == path]
        assert checks == ([check] if check else []), path


_UNREADABLE = {
    "def (": "source-unread",
    "\0": "source-unread",
    "(" * 5_000: "source-unread",
    "x = " + "-" * 100_000 + "1": "source-unparsed",
    "\xff\xfe": "source-encoding",
    "#" * (3 << 20): "source-unparsed",
}


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    """And keeps nothing else from being read."""
    for number, text in enumerate(_UNREADABLE):
        repository(tmp_path / "r", f"{number}.py", text.encode("latin-1"))
    told = surveyed(local(repository(tmp_path / "r", "last.py", "eval(x)")))
    checks = {one.file: set() for one in told}
    for one in told:
        checks[one.file].add(one.id)
    assert checks["last.py"] == {"source-dynamic"}
    for number, (text, check) in enumerate(_UNREADABLE.items()):
        assert check in checks[f"{number}.py"], text[:9]
        assert checks[f"{number}.py"] <= {check, "source-hidden", "source-obscure"}


def test_places_are_named_with_their_lines(tmp_path: Path) -> None:
    text = "a = 1\nb = '\u202ec\u202e'\nd = '\u200b'\ne = '" + "x y " * 700 + "'\n"
    repository(tmp_path / "r", "odd.py", text)
    told = [one for one in surveyed(local(tmp_path / "r")) if one.file == "odd.py"]
    assert [(one.id, one.line, one.message[:12]) for one in told] == [
        ("source-hidden", 2, "holds U+202E"),
        ("source-hidden", 3, "holds U+200B"),
        ("source-obscure", 4, "a line of 28"),
    ]


def test_a_flood_of_hidden_characters_is_bounded(tmp_path: Path) -> None:
    checks = [check for check, _ in found(tmp_path / "r", "\u200b\n" * 100, "notes.md")]
    assert checks.count("source-hidden") == 20


def test_a_long_chain_ends_nothing(tmp_path: Path) -> None:
    """Some versions of Python's parser take it, and others do not."""
    chain = "if x: pass\n" + "elif x: pass\n" * 5_000
    assert {check for check, _ in found(tmp_path / "r", chain)} <= {"source-unparsed"}


def test_what_is_found_in_a_file_is_bounded(tmp_path: Path) -> None:
    checks = [check for check, _ in found(tmp_path / "r", "eval()\n" * 200)]
    assert checks == ["source-dynamic"] * 100 + ["source-unread"]


def test_what_is_read_of_a_repository_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parsing, "MOST_BYTES_IN_ALL", 10_000)
    folder = repository(tmp_path / "r", "odd.py", "")
    for number in range(70):
        (folder / f"part{number:02}.py").write_bytes(b"#" * 150)
    left_over = [one.file for one in surveyed(from_the_hub(folder))]
    assert left_over == sorted(left_over)
    assert left_over[-1] == "part69.py"
    assert 0 < len(left_over) < 10


def test_no_beginning_makes_python_anything_else(tmp_path: Path) -> None:
    starts = ("MZ = 1", "BZh = 1", "#" + " " * 256 + "ustar")
    told = of_each(tmp_path / "r", [f"{start}\nimport subprocess" for start in starts])
    assert [*told.values()] == [{("source-process", 2)}] * len(starts)


def test_machine_code_in_place_of_a_source_fails(tmp_path: Path) -> None:
    """Python takes it first; beside no source of its name it is what it is."""
    folder = repository(tmp_path / "r", "lib/fast.cpython-311-x86_64-linux-gnu.so", b"\x7fELF")
    (folder / "lib/fast.py").write_text("x = 1")
    (folder / "env.abi3.so").write_bytes(b"\x7fELF")
    (folder / "other.so").write_bytes(b"\x7fELF")
    for package in ("lib", "native"):
        (folder / package).mkdir(exist_ok=True)
        (folder / package / "__init__.abi3.so").write_bytes(b"\x7fELF")
    (folder / "lib.py").write_text("x = 1")
    told = surveyed(from_the_hub(folder))
    compiled = {"env.abi3.so", "lib/__init__.abi3.so", "lib/fast.cpython-311-x86_64-linux-gnu.so"}
    assert {one.file for one in told if one.id == "source-compiled"} == compiled


def test_no_flood_hides_what_weighs_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside.keep_few_findings(monkeypatch)
    folder = repository(tmp_path / "r", "z/odd.py", b"# coding: utf-7\n")
    (folder / "z/turned.py").write_text("x = 'a\u202eb'")
    for number in range(12):
        (folder / f"a{number:03}.py").write_text("eval()\n" * 101)
    for number in range(3):
        (folder / f"b{number}.txt").write_text("a b\n" * (1 << 18))
    told = surveyed(from_the_hub(folder))
    assert len(told) > 1_000
    assert [one.message for one in told if one.id == "source-unread" and not one.file] == [
        "2 texts are more than is read: 1 MiB of a file, and 32 MiB in all",
        "there is more to find than is kept",
    ]
    weighs_more = {one.id for one in told if one.file.startswith("z/")}
    assert weighs_more == {"source-encoding", "source-hidden"}


def test_links_are_named(tmp_path: Path) -> None:
    """Those of a folder, and those that git made, which the Hub hands out as texts."""
    folder = repository(tmp_path / "r", "data.txt", "# something else\n")
    (folder / "alias.txt").symlink_to("data.txt")
    told = [one for one in surveyed(local(folder)) if one.id == "source-link"]
    assert [(one.file, one.message) for one in told] == [("alias.txt", "a link to data.txt")]
    for name, target in (("alias.txt", "data.txt"), ("out.txt", "../../etc/x")):
        (folder / name).unlink(missing_ok=True)
        (folder / name).write_text(target)
    told = [one for one in surveyed(from_the_hub(folder)) if one.id == "source-link"]
    assert [one.file for one in told] == ["alias.txt", "out.txt"]


# --- What is read of a Python file is what Python makes of its bytes, or the file is reported


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
    try:
        return ast.dump(compile(source, "file", "exec", ast.PyCF_ONLY_AST, dont_inherit=True))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None


@settings(max_examples=3 * settings().max_examples)
@given(_SOURCES)
def test_what_is_read_is_what_python_makes_of_the_bytes(source: bytes) -> None:
    """The same tree, of the bytes and of the text that is searched; or its encoding is reported."""
    python = tree(source)
    described = parser.described(source)
    if python is None or (described is not None and "encoding" in described):
        return
    read = {name for level, _, names, *_ in described["imports"] if level < 0 for name in names}
    imports = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import))
    assert read == {alias.name for node in imports for alias in node.names}
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


def test_odd_encodings_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each imports a module that a reader does not see; the import itself is the control."""
    for number, source in enumerate(_RUNS.values()):
        repository(tmp_path / "r", f"odd{number}.py", source)
    monkeypatch.syspath_prepend(tmp_path / "r")
    codecs.register(evil)
    try:
        for number, case in enumerate(_RUNS):
            assert hasattr(importlib.import_module(f"odd{number}"), "os"), case
            del sys.modules[f"odd{number}"]
    finally:
        codecs.unregister(evil)
    told = surveyed(local(tmp_path / "r"))
    wrong = {one.file: one for one in told if one.id == "source-encoding"}
    assert sorted(wrong) == [f"odd{number}.py" for number in range(len(_RUNS))]
    assert {one.check.severity for one in wrong.values()} == {Severity.ERROR}


def test_what_is_utf_8_is_read() -> None:
    """However it says so, wherever its lines end, and by the names that Python makes of letters."""
    texts = (
        b"\xef\xbb\xbfimport os",
        b"# -*- coding: utf-8 -*-\nimport os",
        b"# coding: UTF8\r\nimport os",
        b"# coding: us-ascii\rimport os",
        b"x = 1\n# coding: utf-7\nimport os",
        "import \U0001d428\U0001d42c".encode(),
        b"\fimport os\f\n\f",
    )
    parsed = parsing.parsed({str(source): source for source in texts})
    read = {name: [one.names for one in file.imports] for name, file in parsed.items()}
    assert read == {str(source): [["os"]] for source in texts}

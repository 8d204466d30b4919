"""What a file is by its bytes, and what its text and its code give reason to look at."""

from __future__ import annotations

import pickle

import pytest

from envhub_sandbox.check import contents
from envhub_sandbox.hub.sources.parsing import parsed


@pytest.mark.parametrize(
    ("name", "beginning", "kind"),
    [
        ("env.py", b"MZ = 1", "Python"),
        ("a.txt", b"MZ\0\0", "machine code"),
        ("a", b"\x7fELF", "machine code"),
        ("a.so", b"", "machine code"),
        ("a.bin", pickle.dumps({"a": [1]}), "pickle"),
        ("model.pt", b"", "pickle"),
        ("a.pyc", b"", "compiled Python"),
        ("a.zip", b"PK\x03\x04", "archive"),
        ("a.npz", b"PK\x03\x04", "text"),
        ("a.gz", b"\x1f\x8b\x08", "archive"),
        ("w.bin", b"version https://git-lfs.github.com/spec/v1\n", "LFS pointer"),
        ("a.md", "ünïcode".encode(), "text"),
        ("a.md", b"\xff\xfe", "binary"),
        ("a.md", b"a\0b", "binary"),
    ],
)
def test_a_file_is_what_it_begins_with(name: str, beginning: bytes, kind: str) -> None:
    assert contents.kind_of_contents(name, beginning) == kind


def test_an_archive_may_end_a_file_that_begins_otherwise() -> None:
    """Python runs those; one of arrays that names a module is one of these."""
    end = b"PK\x05\x06" + b"\0" * 18
    assert contents.kind_of_contents("a.png", b"\x89PNG", end) == "archive"
    directory = b"a/env.py" + end[:12] + (8).to_bytes(4, "little") + b"\0" * 6
    assert contents.kind_of_contents("a.npz", b"PK\x03\x04", directory) == "archive"


@pytest.mark.parametrize(
    ("kind", "is_folder", "found"),
    [
        ("pickle", False, ["source-pickle"]),
        ("archive", True, ["source-unread"]),
        ("LFS pointer", False, ["source-unread"]),
        ("LFS pointer", True, ["source-uncommitted"]),
        ("text", True, []),
    ],
)
def test_some_kinds_are_worth_a_look(kind: str, is_folder: bool, found: list[str]) -> None:
    """A pointer without its file means another thing in a folder than in a commit."""
    assert [one.id for one in contents.of_kind("f", kind, is_folder=is_folder)] == found


def test_characters_that_nobody_sees_are_named_with_their_line() -> None:
    found = list(contents.hidden("f", "a\nb\u202ec\u202e\nd\u200b", is_code=False))
    assert [(one.line, one.message[:12]) for one in found] == [
        (2, "holds U+202E"),
        (3, "holds U+200B"),
    ]
    assert len(list(contents.hidden("f", "\u200b\n" * 100, is_code=False))) == 20
    mixed = "p\u0430ss = 1"
    assert list(contents.hidden("f", mixed, is_code=False)) == []
    assert len(list(contents.hidden("f", mixed, is_code=True))) == 1


@pytest.mark.parametrize(
    ("code", "check"),
    [
        ("import socket", "source-network"),
        ("from subprocess import run", "source-process"),
        ("import os as o\no.system('x')", "source-process"),
        ("eval('1')", "source-dynamic"),
        ("import numpy\nnumpy.load('x', allow_pickle=True)", "source-pickle"),
        ("import os\ngetattr(os, name)", "source-dynamic"),
        ("import os\ngetattr(os, 'popen')", "source-process"),
        ("import ctypes", "source-native"),
        ("from .socket import x", None),
        ("eval = 3", None),
        ("import numpy\nnumpy.load('x')", None),
    ],
)
def test_constructs_are_found_where_they_are_written(code: str, check: str | None) -> None:
    """By whatever name a module is imported; a module of the repository's own is another."""
    read = parsed({"f.py": code.encode()})["f.py"]
    assert read is not None
    found = list(contents.constructs("f.py", read))
    assert {one.id for one in found} == ({check} if check else set())
    assert all(one.file == "f.py" and one.line == code.count("\n") + 1 for one in found)


def test_lines_that_nobody_reads_to_their_end() -> None:
    [found] = contents.long_lines("f.py", "a\n" + "x" * 2_000 + "\n" + "y" * 1_999)
    assert (found.line, found.message) == (2, "a line of 2000 characters")

"""What ``envhub check`` reads: nothing is imported, and what it cannot read is no crash."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from envhub_sandbox.check import source
from envhub_sandbox.hub.snapshot import local
from tests.support.repositories import write_repository

_ENTRY = """
from __future__ import annotations
import os.path
import helper, parts.arms
from parts import legs
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    import only_for_types
try:
    import perhaps
except ImportError:
    perhaps = None
import yaml

def make_env(n_envs=1, use_async_envs=False):
    import within_a_function
"""


def imported(folder: Path) -> set[tuple[str, str]]:
    """Names, and the files in which they stand."""
    return {(one.name, one.file) for one in source.imports(local(folder))}


def test_imports_are_followed_through_the_repository(tmp_path: Path) -> None:
    """Its own modules are no packages, and what nobody imports is not read."""
    folder = write_repository(tmp_path / "r", _ENTRY)
    (folder / "helper.py").write_text("import helpers_need")
    (folder / "unused.py").write_text("import nobody_needs")
    (folder / "parts").mkdir()
    (folder / "parts/__init__.py").write_text("")
    (folder / "parts/arms.py").write_text("from . import legs\nimport arms_need")
    (folder / "parts/legs.py").write_text("from .arms import x\nfrom legs_need.deep import y")
    assert imported(folder) == {
        ("yaml", "env.py"),
        ("within_a_function", "env.py"),
        ("helpers_need", "helper.py"),
        ("arms_need", "parts/arms.py"),
        ("legs_need", "parts/legs.py"),
    }


def test_what_is_declared_brings_what_it_needs(tmp_path: Path) -> None:
    """Of this interpreter's packages: pytest needs pluggy; nothing declared needs pytest."""
    text = "import numpy, pytest, pluggy\ndef make_env(): pass"
    found = source.imports(local(write_repository(tmp_path / "r", text)))
    nothing = source.undeclared(found, {}, None)
    assert [one.message.split()[0] for one in nothing] == ["pluggy", "pytest"]
    assert {(one.file, one.line) for one in nothing} == {("env.py", 1)}
    assert source.undeclared(found, {"pytest": Requirement("pytest")}, None) == []


def test_an_environment_of_its_own_brings_what_lies_in_it(tmp_path: Path) -> None:
    """Whatever this interpreter has beside."""
    packages = tmp_path / "packages"
    (packages / "yaml").mkdir(parents=True)
    (packages / "single.py").touch()
    text = "import yaml, single, pytest\ndef make_env(): pass"
    found = source.imports(local(write_repository(tmp_path / "r", text)))
    missing = source.undeclared(found, {}, packages)
    assert [one.message.split()[0] for one in missing] == ["pytest"]


@pytest.mark.parametrize(
    "text",
    [
        "def (",
        "\0",
        "if x: pass\n" + "elif x: pass\n" * 5_000,
        "(" * 5_000,
        "x = " + "-" * 100_000 + "1",
        "\xff\xfe",
        "#" * (3 << 20),
    ],
    ids=["syntax", "null", "chain", "nesting", "deep", "bytes", "large"],
)
def test_what_cannot_be_read_is_nothing(text: str, tmp_path: Path) -> None:
    """No crash, no recursion without end, no time for what no person wrote."""
    folder = write_repository(tmp_path / "r", "def make_env(): pass")
    (folder / "odd.py").write_bytes(text.encode("latin-1"))
    assert not [one for one in source.look(local(folder)) if one.file == "odd.py"]


def test_a_file_does_not_choose_how_it_is_read(tmp_path: Path) -> None:
    """Its first line may name a codec, some of which take hours; the control obeys it."""
    data = b"# coding: utf-7\n+AGkAbQBwAG8AcgB0- hidden\n"
    assert "hidden" in ast.dump(ast.parse(data))
    folder = write_repository(tmp_path / "r", "import odd\ndef make_env(): pass")
    (folder / "odd.py").write_bytes(data)
    assert imported(folder) == set()


def test_what_is_found_in_a_file_is_bounded(tmp_path: Path) -> None:
    """Neither long names nor many of them multiply."""
    folder = write_repository(tmp_path / "r", "import odd\ndef make_env(): pass")
    (folder / "odd.py").write_text("eval()\n" * 20_000)
    assert len([one for one in source.look(local(folder)) if one.file == "odd.py"]) == 100
    (folder / "odd.py").write_text(f"from {'a' * 100_000} import {'b,' * 50_000}b")
    [one] = source.imports(local(folder))
    assert len(one.name) == 1024


def test_machine_code_is_named(tmp_path: Path) -> None:
    """By the names of files; nothing opens them."""
    folder = write_repository(tmp_path / "r", "def make_env(): pass")
    (folder / "fast.so").write_bytes(b"\x7fELF")
    assert [one.file for one in source.look(local(folder)) if one.id == "source-native"] == [
        "fast.so"
    ]

"""What ``envhub check`` reads: nothing is imported, and what it cannot read is no crash."""

import ast
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from envhub_sandbox.extras.judge.static import undeclared
from envhub_sandbox.extras.sources import parser, parsing
from envhub_sandbox.extras.sources import parsing as source
from envhub_sandbox.hub.snapshot import Snapshot, local
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
    return {(one.name, one.file) for one in imports(local(folder))}


def imports(snapshot: Snapshot) -> list[source.Import]:
    """What ``source.imports`` finds in what was read of a snapshot."""
    return source.imports(snapshot, parsing.read(snapshot))


def test_imports_are_followed_through_the_repository(tmp_path: Path) -> None:
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
    found = imports(local(write_repository(tmp_path / "r", text)))
    nothing = undeclared(found, {}, None)
    assert [one.message.split()[0] for one in nothing] == ["pluggy", "pytest"]
    assert {(one.file, one.line) for one in nothing} == {("env.py", 1)}
    assert undeclared(found, {"pytest": Requirement("pytest")}, None) == []


def test_an_environment_of_its_own_brings_what_lies_in_it(tmp_path: Path) -> None:
    packages = tmp_path / "packages"
    (packages / "yaml").mkdir(parents=True)
    (packages / "single.py").touch()
    text = "import yaml, single, pytest\ndef make_env(): pass"
    found = imports(local(write_repository(tmp_path / "r", text)))
    missing = undeclared(found, {}, packages)
    assert [one.message.split()[0] for one in missing] == ["pytest"]
    taken = {
        "yaml": "env.py, line 1, which needs yaml",
        "Box2D": "env.py, line 9, which needs Box2D",
    }
    told = undeclared(found, {}, packages, taken)
    assert [one.message.partition(",")[0] for one in told] == [
        *("pytest is imported", "yaml is imported", "env.py")
    ]
    assert "line 9, which needs Box2D, and nothing declares it" in told[2].message


def test_a_file_does_not_choose_how_it_is_read(tmp_path: Path) -> None:
    """Its first line may name a codec, some of which take hours; the control obeys it."""
    data = b"# coding: utf-7\n+AGkAbQBwAG8AcgB0- hidden\n"
    assert "hidden" in ast.dump(ast.parse(data))
    folder = write_repository(tmp_path / "r", "import odd\ndef make_env(): pass")
    (folder / "odd.py").write_bytes(data)
    assert imported(folder) == set()


def test_names_are_bounded(tmp_path: Path) -> None:
    folder = write_repository(tmp_path / "r", "import odd\ndef make_env(): pass")
    (folder / "odd.py").write_text(f"from {'a' * 100_000} import {'b,' * 50_000}b")
    [one] = imports(local(folder))
    assert len(one.name) == 1024


def weaker(folder: Path, *changes: tuple[str, str]) -> str:
    text = Path(parser.__file__).read_text()
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / "weaker.py").write_text(text)
    return str(folder / "weaker.py")


@pytest.mark.parametrize(
    ("bound", "spend"),
    [("CPU_S = 0.5", "any(iter(int, 1))"), ("MEMORY = 1 << 29", "bytes(1 << 30)")],
    ids=["time", "memory"],
)
def test_a_file_that_costs_too_much_is_not_read(
    bound: str, spend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel sees to it, and those beside it are read; without the cost it is read, too."""
    texts = {"first.py": b"import a", "second.py": b"import SPEND", "third.py": b"import c"}
    read = parsing.parsed(texts)
    assert [one and one.imports[0].names for one in read.values()] == [["a"], ["SPEND"], ["c"]]
    name = bound.partition(" ")[0]
    [old] = [line for line in Path(parser.__file__).read_text().splitlines() if name + " =" in line]
    spending = f"\n        assert b'SPEND' not in data or not {spend}, data\n        tree = "
    change = ((old, bound), ("\n        tree = ", spending))
    monkeypatch.setattr(parser, "__file__", weaker(tmp_path, *change))
    assert parsing.parsed(texts) == {**read, "second.py": None}


@pytest.mark.parametrize(
    ("each_takes_s", "limits_s"), [(0.0, [600.0] * parsing.MOST_LOST), (400.0, [600.0, 200.0])]
)
def test_lost_children_are_counted(
    each_takes_s: float, limits_s: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And have ten minutes together."""
    ended = weaker(tmp_path, ("  tree = ", "  signal.raise_signal(9)\n        tree = "))
    monkeypatch.setattr(parser, "__file__", ended)
    began: list[float] = []
    run = subprocess.run
    monkeypatch.setattr(parsing, "monotonic", lambda: each_takes_s * len(began))

    def run_child(*arguments: Any, timeout: float, **options: Any) -> object:
        began.append(timeout)
        return run(*arguments, timeout=timeout, **options)

    monkeypatch.setattr(subprocess, "run", run_child)
    assert set(parsing.parsed({f"{number}.py": b"" for number in range(1000)}).values()) == {None}
    assert began == limits_s


def test_only_a_regular_file_is_read(tmp_path: Path) -> None:
    """A pipe reads as an empty file while nothing writes into it, and as anything once it does."""
    os.mkfifo(tmp_path / "env.py")
    assert parsing.content(tmp_path / "env.py", 100) is None
    (tmp_path / "other.py").touch()
    assert parsing.content(tmp_path / "other.py", 100) == b""


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    """A snapshot holds real files; whoever swaps one afterwards leads nobody out of it."""
    folder = write_repository(tmp_path / "r", "import a\ndef make_env(): pass")
    snapshot = local(folder)
    (tmp_path / "outside.py").write_text("import secret")
    swapped = tmp_path / "swapped"
    swapped.mkdir()
    (swapped / "env.py").symlink_to(tmp_path / "outside.py")
    assert parsing.read(snapshot)["env.py"] is not None
    assert parsing.read(replace(snapshot, root=swapped))["env.py"] is None


def test_a_chain_of_files_with_many_imports_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stranger chooses both, before there is a sandbox. The control: a short chain, in any order
    of files and of uses.
    """
    last = "def load():\n    import deep\ndef unused():\n    import nobody_needs\n"
    rest = {f"m{at}.py": f"import x{at}, m{at + 1}\n" for at in range(1, 30)} | {"m30.py": last}
    folder = write_repository(tmp_path / "r", "import m1\ndef make_env():\n    load()\n")
    for name, text in rest.items():
        (folder / name).write_text(text)
    followed: list[object] = []
    named = parsing.named_modules
    monkeypatch.setattr(
        parsing, "named_modules", lambda one, file: followed.append(one) or named(one, file)
    )
    snapshot = local(folder)
    assert {one.name for one in imports(snapshot)} == {"deep", *(f"x{at}" for at in range(1, 30))}
    assert len(followed) == 31
    monkeypatch.setattr(parsing, "_MOST_IMPORTED", 30)
    assert 9 <= len(imports(snapshot)) <= 10

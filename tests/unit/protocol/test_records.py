"""Records are what the standard library makes of the same fields, but for how they are made."""

import copy
import dataclasses
import inspect
import pickle
import subprocess
import sys
from dataclasses import field
from pathlib import Path
from typing import Any

import pytest

from envhub_worker import bootstrap
from envhub_worker.protocol import records


@records.dataclass(frozen=True)
class Ours:
    """Defaults of both kinds, and a field that is neither compared nor shown."""

    first: int
    second: str = "b"
    third: list[int] = field(default_factory=list)
    last: object = field(default=None, compare=False, repr=False)


@dataclasses.dataclass(frozen=True)
class Theirs:
    """The same of the standard library."""

    first: int
    second: str = "b"
    third: list[int] = field(default_factory=list)
    last: object = field(default=None, compare=False, repr=False)


@records.dataclass(frozen=True, kw_only=True)
class Named:
    """Nothing may be given in order."""

    only: int


@records.dataclass(frozen=True, repr=False)
class Below(Ours):
    """A field more, and the parent's ``repr``."""

    more: tuple[int, ...] = ()


CALLS: list[tuple[tuple[Any, ...], dict[str, Any]]] = [
    ((1,), {}),
    ((1, "x"), {"last": 4}),
    ((), {"first": 1, "third": [3]}),
    ((1, "x", [2], None), {}),
]
WRONG = [((), {}), ((1, "x", [2], None, 5), {}), ((1,), {"first": 2}), ((1,), {"other": 2})]


@pytest.mark.parametrize(("values", "named"), CALLS)
def test_fields_are_the_standard_librarys(values: tuple[Any, ...], named: dict[str, Any]) -> None:
    ours, theirs = Ours(*values, **named), Theirs(*values, **named)
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)
    assert repr(ours) == repr(theirs).replace("Theirs", "Ours")
    changed = dataclasses.replace(ours, second="c")
    assert (changed.first, changed.second, changed.third) == (ours.first, "c", ours.third)


@pytest.mark.parametrize(("values", "named"), WRONG)
def test_wrong_arguments_are_refused_alike(values: tuple[Any, ...], named: dict[str, Any]) -> None:
    for kind in (Theirs, Ours):
        with pytest.raises(TypeError):
            kind(*values, **named)


def test_fields_by_name_are_not_taken_in_order() -> None:
    assert Named(only=1).only == 1
    with pytest.raises(TypeError, match="Named takes only"):
        Named(1)


def test_records_do_not_change() -> None:
    record: Any = Ours(1)
    for name in ("first", "other"):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(record, name, 2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        del record.first
    assert record.first == 1


def test_equality_and_hash_go_by_compared_fields_of_one_class() -> None:
    assert Named(only=1) == Named(only=1)
    assert hash(Named(only=1)) == hash(Named(only=1))
    assert Named(only=1) != Named(only=2)
    assert Ours(1, last=2) == Ours(1, last=3)
    assert Ours(1).third is not Ours(1).third
    assert Ours(1) != Below(1)
    assert Named(only=1) != 1


@records.dataclass(frozen=True)
class Checked:
    """One that looks at what it was given."""

    first: int
    second: str = "b"

    def __post_init__(self) -> None:
        if self.first < 0:
            raise ValueError("first is negative")
        object.__setattr__(self, "second", self.second.upper())


def test_what_was_given_is_looked_at() -> None:
    assert Checked(1).second == dataclasses.replace(Checked(2), first=1).second == "B"
    for make in (lambda: Checked(-1), lambda: dataclasses.replace(Checked(1), first=-1)):
        with pytest.raises(ValueError, match="negative"):
            make()


def test_a_notebook_shows_the_fields() -> None:
    ours, theirs = inspect.signature(Ours).parameters, inspect.signature(Theirs).parameters
    assert [str(one) for one in ours.values() if one.name != "third"] == [
        str(one) for one in theirs.values() if one.name != "third"
    ]
    assert ours["third"].default == []
    assert str(inspect.signature(Named)) == "(*, only: int)"


def test_subclasses_add_fields() -> None:
    below = Below(1, more=(2,))
    assert [one.name for one in dataclasses.fields(below)][-1] == "more"
    assert repr(below) == "Below(first=1, second='b', third=[])"
    assert below == Below(1, more=(2,)) != Below(1)


def test_copies_are_equal() -> None:
    record = Ours(1, third=[1, 2])
    assert copy.deepcopy(record) == pickle.loads(pickle.dumps(record)) == record


def test_a_server_imports_next_to_nothing_before_its_zygote(tmp_path: Path) -> None:
    """What stands before it in a server's start takes time that nothing else does."""
    program = (
        "import runpy, subprocess, sys\n"
        "subprocess.Popen = lambda command, **_: sys.exit(print(command[-3], *sys.modules))\n"
        f"sys.argv = [{bootstrap.__file__!r}, 'worker', 'serve', '--ahead', '--endpoint', 'ipc://x',"
        f" '--runtime-dir', {str(tmp_path)!r}]\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    found = subprocess.run(
        [sys.executable, "-I", "-S", "-c", program], stdout=subprocess.PIPE, text=True, check=True
    )
    what, *modules = found.stdout.split()
    assert what == "zygote"
    assert "argparse" in modules
    assert not {"email", "importlib.metadata", "inspect", "zipfile", "zmq"} & {*modules}

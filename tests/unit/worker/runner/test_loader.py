"""A caller's config object, made again of the plain values that have crossed."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.protocol.messages import CONFIG_CLASS
from envhub_worker.runner.loader import ConfigMapping, config_of
from tests.support.command_line import python


@dataclasses.dataclass
class Camera:
    """A class that both sides have."""

    width: int
    name: str = "top"


def described(*names: tuple[str, str], fields: Any, **values: Any) -> Any:
    """As it crosses: the values, and what is said of their class."""
    return {**values, CONFIG_CLASS: (names, fields, {})}


def test_the_class_itself_is_used_where_it_is_here() -> None:
    """No code of it decides: a missing field has its default, and no argument is required."""
    made = config_of(described((__name__, "Camera"), fields=("width", "name"), width=3))
    assert made == Camera(3)
    assert type(made) is Camera


@pytest.mark.parametrize("value", [5, "text", None, [1, {"a": 2}], (1, 2), {"a": {"b": [3]}}])
def test_plain_values_stay_what_they_are(value: Any) -> None:
    assert config_of(value) == value
    assert type(config_of(value)) is type(value)


def test_nested_objects_are_made_too() -> None:
    camera = described((__name__, "Camera"), fields=("width", "name"), width=3, name="top")
    said = {"cameras": [camera], "more": described(fields=None, left=camera)}
    made = config_of(said)
    assert made["cameras"] == [Camera(3)]
    assert type(made["more"]) is ConfigMapping
    assert made["more"]["left"] == made["more"].left == Camera(3)


def test_what_cannot_be_made_is_named() -> None:
    said = described(("arena", "Bad"), fields=("not a name",), **{"not a name": 1})
    with pytest.raises(TypeError, match="Bad cannot be made from not a name"):
        config_of(said)


_IMPORTS = """
import sys
from pathlib import Path
import numpy as np
from envhub_worker.protocol import messages as m
from envhub_worker.runner.loader import PACKAGE
from envhub_worker.spawn import zygote
from tests.support.in_process.runner_here import RunnerHere

zygote.preload("envhub_worker.runner.runner")
before = set(sys.modules)

def listed():
    finders = [(path, finder) for path, finder in sys.path_importer_cache.items() if finder]
    return {path: vars(finder).get("_path_mtime") for path, finder in finders}

lists = listed()
runner = RunnerHere(Path(sys.argv[1]))
runner.ask(m.Reset(1, (1, 2), None, None))
runner.ask(m.Step(1, np.zeros(2, np.int64)))
print([name for name in sys.modules.keys() - before if name.partition(".")[0] != PACKAGE])
print([path for path in lists if listed()[path] != lists[path]])
"""


def test_a_runner_imports_and_lists_nothing_that_the_zygote_has_not() -> None:
    """What each runner imports, and which folders of packages it lists, for itself takes time at
    each start, and memory of its own."""
    root = Path(__file__).parents[4]
    done = python("-c", _IMPORTS, root / "tests" / "samples" / "counter", cwd=root)
    assert done.stdout == "[]\n[]\n"

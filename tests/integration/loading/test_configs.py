"""A caller's config object, as the repository's ``make_env`` gets it for ``cfg``."""

import sys
import types
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

import pytest

from envhub_sandbox import make_env
from tests.support.repositories import STILL, write_repository

_PARTS = """
from dataclasses import dataclass, field
from enum import Enum

class Mode(Enum):
    FAST = "fast"

@dataclass
class Base:
    fps: int = 30

    def speed(self):
        return self.fps * 2

@dataclass
class Arm:
    joints: int
    mode: Mode = Mode.FAST
"""
_READS = (
    STILL
    + """
import dataclasses
import pathlib
try:
    import known_parts
except ImportError:
    known_parts = None

def make_env(n_envs=1, use_async_envs=False, cfg=None):
    made = vector(Still, n_envs)
    seen = {
        "name": type(cfg).__name__,
        "module": type(cfg).__module__,
        "fields": [one.name for one in dataclasses.fields(cfg)],
        "dict": repr(dataclasses.asdict(cfg)),
        "replaced": dataclasses.replace(cfg, episodes=9).episodes,
        "camera": type(cfg.camera).__name__,
        "arm": type(cfg.arm).__name__,
        "joints": cfg.arm.joints,
        "where": isinstance(cfg.where, pathlib.PurePath),
        "type": cfg.type,
        "vars": sorted(vars(cfg)),
    }
    if known_parts is not None:
        seen["base"] = isinstance(cfg, known_parts.Base) and cfg.speed()
        seen["same arm"] = cfg.arm == known_parts.Arm(7, known_parts.Mode.FAST)
    Still.seen = seen
    return made
"""
)


class Mode(Enum):
    """What an arm does."""

    FAST = "fast"


@dataclass
class Arm:
    """A nested config."""

    joints: int
    mode: Mode = Mode.FAST


@dataclass
class Base:
    """What a config inherits from."""

    fps: int = 30


@dataclass
class ArmEnvConfig(Base):
    """A config as LeRobot's are: fields, properties and methods."""

    hub_path: str = ""
    episodes: int = 3
    arm: Any = field(default_factory=lambda: Arm(7))
    camera: dict[str, Any] = field(default_factory=lambda: {Mode.FAST: 1, ("a", 2): 3, "width": 64})
    where: Path = Path("somewhere")
    shared: ClassVar[int] = 5

    @property
    def type(self) -> str:
        """As LeRobot's, which are named by it."""
        return "arms"

    def validate(self) -> bool:
        return True


@dataclass(frozen=True)
class Left:
    """Values that have no plain form."""

    hub_path: str
    callback: Any
    episodes: int = 3
    arm: Any = None
    camera: Any = None
    where: Any = Path("x")
    type: str = "t"


for _one in (Mode, Arm, Base, ArmEnvConfig, Left):
    _one.__module__ = "somebodys_trainer"  # where a jail finds nothing


def seen(cfg: Any) -> Any:
    with make_env(cfg) as suites:
        return suites.env.get_attr("seen")[0]


def test_a_dataclass_arrives_as_one_of_its_name(tmp_path: Path) -> None:
    """``fields``, ``asdict`` and ``replace`` work where its class is not to be had."""
    folder = write_repository(tmp_path / "repo", _READS)
    found = seen(ArmEnvConfig(hub_path=str(folder)))
    names = ["fps", "hub_path", "episodes", "arm", "camera", "where"]
    assert found["name"] == "ArmEnvConfig"
    assert found["fields"] == names
    assert "'arm': {'joints': 7, 'mode': 'fast'}" in found["dict"]
    assert "'camera': {'fast': 1, ('a', 2): 3, 'width': 64}" in found["dict"]
    assert (found["replaced"], found["joints"]) == (9, 7)
    assert (found["arm"], found["camera"], found["where"]) == ("Arm", "dict", True)
    assert found["type"] == "arms"
    assert found["vars"] == sorted(names)


def test_classes_that_the_jail_has_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``isinstance`` holds, methods are theirs, and what was made here is equal to theirs there."""
    folder = write_repository(tmp_path / "repo", _READS, known_parts__py=_PARTS)
    parts = types.ModuleType("known_parts")
    monkeypatch.setitem(sys.modules, "known_parts", parts)
    exec(_PARTS, vars(parts))

    @dataclass(kw_only=True)
    class OfTheCaller(parts.Base):
        hub_path: str
        episodes: int = 3
        arm: Any = field(default_factory=lambda: parts.Arm(7))
        camera: dict[str, Any] = field(default_factory=dict)
        where: Path = Path("somewhere")
        type: str = "arms"

    cfg = OfTheCaller(fps=20, hub_path=str(folder))
    found = seen(cfg)
    assert (found["name"], found["base"], found["same arm"]) == ("OfTheCaller", 40, True)


def test_what_has_no_plain_form_is_no_field(tmp_path: Path) -> None:
    """Nothing of the caller's is pickled: a function stays here, and the rest can be read."""
    folder = write_repository(tmp_path / "repo", _READS)
    found = seen(Left(str(folder), callback=print, arm=Arm(1), camera={}))
    assert "callback" not in found["fields"]
    assert found["joints"] == 1

"""What a process has once: whatever of it changes is noticed, and named."""

import os
import random
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from envhub_worker.protocol.messages.prefix import SHARED_STATE
from envhub_worker.runner.state.shared_state import SharedState


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module of the repository, in a process whose other state is put back afterwards."""
    module = ModuleType("shared_state_scene")
    module.__file__ = str(tmp_path / "scene.py")
    module.Scene = type("Scene", (), {"__module__": module.__name__, "best": 0})
    module.log = []
    module.space = spaces.Dict(a=spaces.Discrete(9, seed=1))
    module.generator, module.python = np.random.default_rng(1), random.Random(1)
    module.numpy = np.random.RandomState(1)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setenv("SCENE", "1")
    monkeypatch.chdir(os.getcwd())
    random.random()  # where nobody has drawn since a seed, another seed moves neither word
    return module


CHANGES: list[tuple[str, Callable[[ModuleType], object]]] = [
    ("numpy.random", lambda scene: np.random.rand()),
    ("numpy.random", lambda scene: np.random.seed(3)),
    ("random", lambda scene: random.random()),
    ("random", lambda scene: random.seed(3)),
    ("module", lambda scene: setattr(scene, "episodes", 1)),
    ("module", lambda scene: setattr(scene.Scene, "best", 1)),
    ("module", lambda scene: scene.log.append(1)),
    ("module", lambda scene: scene.space.sample()),
    ("module", lambda scene: scene.generator.random()),
    ("module", lambda scene: scene.python.random()),
    ("module", lambda scene: scene.numpy.rand()),
    ("environment", lambda scene: os.environ.update(SCENE="2")),
    ("directory", lambda scene: os.chdir("/")),
]


def test_there_is_a_change_of_each_kind() -> None:
    """But of torch's generator, which is with what needs torch."""
    assert {name for name, _ in CHANGES} == set(SHARED_STATE) - {"torch"}


@pytest.mark.parametrize(("name", "change"), CHANGES)
def test_a_change_is_reported_once_by_its_name(
    scene: ModuleType, tmp_path: Path, name: str, change: Callable[[ModuleType], object]
) -> None:
    reported: list[str] = []
    state = SharedState(str(tmp_path), reported.append)
    state.built([SimpleNamespace()])
    state.look_closely()
    np.random.default_rng().random()
    random.Random().random()
    for look in (state.look, state.look_closely):
        look()
    assert reported == []
    for _ in range(2):
        change(scene)
        state.look_closely() if name not in ("numpy.random", "random") else state.look()
    assert reported == [name]


def test_what_takes_long_to_read_is_looked_at_by_itself(scene: ModuleType, tmp_path: Path) -> None:
    """Not at each step, and ever more seldom."""
    reported: list[str] = []
    state = SharedState(str(tmp_path), reported.append)
    looks = 0
    while not reported and looks < 1 << 12:
        looks += 1
        state.look()
        scene.Scene.best += 1
    assert reported == ["module"]

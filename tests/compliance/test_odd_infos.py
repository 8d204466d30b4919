"""Infos that the wire has no form for lose nothing but themselves, in one process and several."""

import contextlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from envhub_sandbox import SandboxEnv, make_env
from envhub_sandbox.errors import RemoteEnvError
from envhub_worker.protocol.codec.inert import RemoteObject
from tests.compliance.differential.cases import without_members
from tests.compliance.differential.scripted import Level, Mode
from tests.compliance.theirs.through_sandbox import by_value, vector
from tests.support.compare import assert_same
from tests.support.repositories import STILL, write_repository

_ENV = """
deep = []
for _ in range(40):
    deep = [deep]
ODD = {
    "structured": np.array([(1, 2.5)], [("a", "i4"), ("b", "f8")]),
    "record": np.array([(1, 2.5)], [("a", "i4"), ("b", "f8")])[0],
    "void": np.void(b"abc"),
    "long": np.longdouble(1.5),
    "longs": np.array([1.5, 2.5], np.longdouble),
    "deep": deep,
    "many": [0] * 250_000,
    "text": "x" * (5 << 20),
    "integer": [2 ** 10_000],
}

class Odd(Still):
    observation_space = gym.spaces.Box(0, 100, (2,))

    def reset(self, *, seed=None, options=None):
        self.n, self.odd = 0, ODD[options["odd"]]
        return np.zeros(2, np.float32), {"before": 1, "odd": self.odd, "after": "text"}

    def step(self, action):
        self.n += 1
        info = {"before": self.n, "odd": self.odd, "after": "text"}
        return np.full(2, self.n, np.float32), float(self.n), False, False, info

    def tell(self):
        return self.odd
"""
ODD = ("structured", "record", "void", "long", "longs", "deep", "many", "text", "integer")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_repository(tmp_path_factory.mktemp("odd"), STILL + _ENV)


def _is_inert(value: Any) -> bool:
    if isinstance(value, (list, tuple, np.ndarray)):
        return any(map(_is_inert, value))
    return isinstance(value, RemoteObject)


@pytest.mark.parametrize(
    "options", [{}, {"policy": {"lane": "frames"}}, {"num_workers": 2}], ids=str
)
def test_the_rest_of_a_step_arrives(folder: Path, options: dict[str, Any]) -> None:
    """Observations, rewards, flags, other infos; and of what is odd its value or a description."""
    with make_env(folder, n_envs=2, **options) as suites:
        env = suites.env
        for odd in ODD:
            infos = env.reset(options={"odd": odd})[1]
            for step in range(1, 4):
                assert infos["before"].tolist() == [max(1, step - 1)] * 2, odd
                assert infos["after"].tolist() == ["text"] * 2, odd
                assert infos["_odd"].all(), odd
                observation, rewards, _, _, infos = env.step(np.zeros(2, int))
                assert observation.tolist() == [[step, step]] * 2, odd
                assert rewards.tolist() == [step, step], odd
            if odd in ODD[5:]:
                assert _is_inert(infos["odd"]), odd
                with pytest.raises(RemoteEnvError, match="cannot be sent"):
                    env.call("tell")


def test_one_environment_has_plain_values_of_them(folder: Path) -> None:
    expected = [[(1, 2.5)], (1, 2.5), b"abc", np.float64(1.5), [1.5, 2.5]]
    with contextlib.closing(SandboxEnv(folder)) as env:
        for odd, value in zip(ODD, expected, strict=False):
            env.reset(options={"odd": odd})
            found = env.step(0)[4]["odd"]
            if isinstance(value, list):
                assert found.tolist() == value
            else:
                assert (type(found), found) == (type(value), value)


_WITHOUT: dict[str, Any] = {}
BY_ROW: dict[str, list[dict[Any, Any]]] = {
    "a member first": [{"a": Level.LOW}, {"a": 2}, {"a": 3}],
    "a member later": [{"a": 1}, {"a": Level.LOW}, {"a": 2.5}],
    "members as keys": [{Mode.FAST: 1}, {Level.LOW: 2.5, "b": {Mode.FAST: 1}}, {"fast": 2.5}],
    "an object of no dimension": [_WITHOUT, {"a": np.array(None)}, {"b": {"c": np.array(None)}}],
    "one after None": [{"a": None}, _WITHOUT, _WITHOUT, {"a": np.array(None)}],
    "one beside None": [{"a": None}, {"a": np.array(None)}, _WITHOUT],
    "its own mask": [_WITHOUT, {"_a": 1, "a": "x"}, _WITHOUT],
}


class Tells(gym.Env[Any, Any]):
    """Its infos are what its row of ``BY_ROW`` says."""

    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, infos: dict[Any, Any]) -> None:
        self.infos = infos

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return 0, self.infos

    def step(self, action: Any) -> Any:
        return 1, 0.0, len(self.infos) > 1, False, self.infos


SEVERAL = pytest.mark.parametrize(
    "options",
    [
        {"num_workers": 3},
        {"num_workers": 3, "policy": {"lane": "frames"}},
        {"sandbox": ["process"] * 2},
    ],
    ids=str,
)


@SEVERAL
def test_classes_that_the_wire_changes_decide_as_in_gymnasium(options: dict[str, Any]) -> None:
    """Which column a value makes, what a mask is called, and what rows without it hold."""
    for name, rows in BY_ROW.items():
        make = [lambda row=row: Tells(row) for row in rows]
        reference = SyncVectorEnv(make)
        with by_value(), contextlib.closing(vector(make, options=options)) as env:
            for name_of_call, args in (("reset", ()), ("step", ([0] * len(rows),))):
                expected = getattr(reference, name_of_call)(*args)[-1]
                infos = getattr(env, name_of_call)(*args)[-1]
                assert_same(without_members(expected), infos, name)


@SEVERAL
def test_a_step_whose_infos_cannot_be_joined_notes_no_end(options: dict[str, Any]) -> None:
    """With autoreset disabled the next step is one, as in Gymnasium."""
    make = [lambda row=row: Tells({"b": row}) for row in range(3)]
    mode: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}
    reference = SyncVectorEnv(make, **mode)
    with by_value(), contextlib.closing(vector(make, options=options, **mode)) as env:
        for one in (reference, env):
            one.reset()
            one.set_attr("infos", [{"a": 1}, {"a": 2}, {"a": "text", "ends": True}])
            with pytest.raises(ValueError, match="text"):
                one.step([0] * 3)
            one.set_attr("infos", {"a": 3})
        assert_same(reference.step([0] * 3), env.step([0] * 3))

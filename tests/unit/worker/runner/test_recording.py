"""What stands in for Gymnasium's vector environments: built when looked into, never by its end."""

import copy
import gc
import os
import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from envhub_worker.runner.recording import recording, standing_in

KINDS = {"sync": SyncVectorEnv, "async": AsyncVectorEnv}


class Counted:
    """Makes CartPoles, and leaves a file for each, whichever process makes it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self) -> gym.Env[Any, Any]:
        (self.folder / os.urandom(8).hex()).touch()
        return gym.make("CartPole-v1")

    @property
    def built(self) -> int:
        return len(list(self.folder.iterdir()))


def stand_in(kind: str, maker: Counted) -> Any:
    with standing_in():
        return KINDS[kind]([maker] * 2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("end", ["collected", "closed", "wrapped", "pickled"])
def test_its_end_builds_nothing(kind: str, end: str, tmp_path: Path) -> None:
    maker = Counted(tmp_path)
    env = stand_in(kind, maker)
    assert recording(env) is not None
    if end == "closed":
        env.close()
        env.close()
    elif end == "wrapped":
        gym.vector.VectorWrapper(env).close()
    elif end == "pickled":
        pickle.dumps(env)
    del env
    gc.collect()
    assert maker.built == 0


@pytest.mark.parametrize("kind", KINDS)
def test_who_looks_into_it_has_it_built(kind: str, tmp_path: Path) -> None:
    """The control: the same count sees what is built."""
    maker = Counted(tmp_path)
    env = stand_in(kind, maker)
    assert env.single_action_space == gym.spaces.Discrete(2)
    assert recording(env) is None
    assert maker.built >= 2
    env.close()


@pytest.mark.parametrize("kind", KINDS)
def test_a_copy_stands_in_too(kind: str, tmp_path: Path) -> None:
    maker = Counted(tmp_path)
    env = stand_in(kind, maker)
    with standing_in():
        again = copy.deepcopy(env)
    assert len(recording(again).env_fns) == 2
    assert maker.built == 0


def test_closed_and_then_looked_into_it_is_closed(tmp_path: Path) -> None:
    env = stand_in("async", Counted(tmp_path))
    env.close()
    assert env.closed
    assert recording(env) is None
    with pytest.raises(ClosedEnvironmentError):
        env.reset()

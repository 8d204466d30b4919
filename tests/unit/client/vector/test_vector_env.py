"""Ctrl-C between any two statements: the next request is not held up, nor sent as another."""

import copy
import pickle
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.session import requests
from envhub_sandbox.transport.shared_memory import client_slabs
from envhub_sandbox.transport.shared_memory.client_slabs import LaneShard
from envhub_sandbox.vector import vector_env
from envhub_sandbox.vector.sandbox_view import SandboxView
from envhub_sandbox.vector.space_copies import SpaceCopies
from envhub_sandbox.vector.sub_environment import SubEnvironment
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.shared_memory import slabs
from tests.support import inside
from tests.support.in_process.fake_lane import FakeLane, session_over
from tests.support.in_process.interrupts import before_line


@pytest.mark.parametrize(
    "act",
    [
        lambda env: env.reset(),
        lambda env: env.render(),
        lambda env: env.call("here"),
        lambda env: env.set_attr("here", 1),
        lambda env: env.step(env.action_space.sample()),
    ],
    ids=["reset", "render", "call", "set_attr", "step"],
)
@pytest.mark.parametrize("module", [vector_env, requests])
def test_interrupts_leave_no_endless_wait(module: ModuleType, act: Callable[[Any], object]) -> None:
    """A reset brings the environment back, wherever it was, and takes no other's answer."""
    line = 0
    while True:
        env = SandboxVectorEnv(session_over(FakeLane()))
        came = before_line(module.__file__, line, lambda env=env: act(env))
        observations, infos = env.reset()
        assert (observations.shape[0], infos) == (env.num_envs, {})
        env.close()
        if not came:
            break
        line += 1
    assert line > 3


class _Runner:
    """The other end of a slab: it reads its wishes again where their count has changed."""

    def __init__(self) -> None:
        layout = slabs.layout_of(spaces.Discrete(5), 1)
        self.lane = LaneShard(layout, 0)
        self._changes = 0
        self._wishes: tuple[int, int] = (0, 0)

    def asked(self, dtype: str, slot: int) -> tuple[int, int, int]:
        """What it makes of a step: length of a message, code of the dtype, slot."""
        ask(self.lane, dtype, slot)
        words = inside.request_words(self.lane)
        if words[slabs.CHANGES] != self._changes:
            self._changes = words[slabs.CHANGES]
            self._wishes = words[slabs.DTYPES], words[slabs.SLOT]
        return words[slabs.MESSAGE], *self._wishes


def ask(lane: LaneShard, dtype: str, slot: int) -> None:
    lane.write([np.zeros(1, dtype)], (slot, 0, 0))


@pytest.mark.parametrize("afterwards", [("int64", 0), ("int32", 1)])
@pytest.mark.parametrize("what", ["step", "message"])
def test_a_runner_is_told_all_after_an_interrupt(what: str, afterwards: tuple[str, int]) -> None:
    """Whether the next step is like the interrupted one, or like the one before it."""
    dtype, slot = afterwards
    expected = (0, slabs.DTYPE_CODES[np.dtype(dtype)], slot)
    line = 0
    while True:
        runner = _Runner()
        lane = runner.lane
        runner.asked("int64", 0)

        def act(lane: LaneShard = lane) -> None:
            if what == "step":
                ask(lane, "int32", 1)
            else:
                lane.write_message([b"message"], (1, 0, 0))

        came = before_line(client_slabs.__file__, line, act)
        assert runner.asked(dtype, slot) == expected
        lane.close()
        if not came:
            break
        line += 1
    assert line > 4


# --- ``env.sandbox`` beside other programs of the caller's: copies, pickles, logs


class Session:
    """One that notes whether a copy of it was begun."""

    repository = SimpleNamespace(label="org/repo")
    begun = False

    def __reduce__(self) -> tuple[Any, ...]:
        self.begun = True
        return Session, ()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_it_is_not_copied(copied: Callable[[object], object]) -> None:
    """Nor is the session behind it, whose sockets a half-made copy would close."""
    session: Any = Session()
    with pytest.raises(TypeError, match=r"<sandbox of org/repo> .* pickle that environment"):
        copied(SandboxView(session))
    assert not session.begun


# --- A handle on one sub-environment, and a worker that answers as it likes


def one_of_two(value: object) -> SubEnvironment:
    """The first of two, of which everything is the same."""
    space = spaces.Discrete(2)
    manifest = SimpleNamespace(sync=True, shardable=True)
    asked = SimpleNamespace(ask_one=lambda name, index, message: m.Value(value))
    fields = {"_manifest": manifest, "_requests": asked, "_spaces": SpaceCopies()}
    vector = SimpleNamespace(num_envs=2, single_observation_space=space, **fields)
    return SubEnvironment(vector, 0)


def test_wrappers_without_end_are_refused() -> None:
    env: Any = one_of_two(RemoteObject("gymnasium.Wrapper", "<Wrapper>"))
    wrappers = 0
    with pytest.raises(RemoteProtocolError, match="wrappers"):  # noqa: PT012
        while hasattr(env, "env"):
            env, wrappers = env.env, wrappers + 1
    assert wrappers == 1000
    assert isinstance(env.unwrapped, SubEnvironment)


def test_what_is_neither_true_nor_false_breaks_the_rules() -> None:
    assert one_of_two(1).has_wrapper_attr("a") is True
    with pytest.raises(RemoteProtocolError):
        one_of_two(np.zeros(2)).has_wrapper_attr("a")

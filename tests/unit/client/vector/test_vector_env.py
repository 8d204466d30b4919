"""Ctrl-C between any two statements: the next request is not held up, nor sent as another."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.session import requests
from envhub_sandbox.transport.shared_memory import shard
from envhub_sandbox.transport.shared_memory.shard import LaneShard
from envhub_sandbox.vector import vector_env
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
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
def test_an_interrupted_request_leaves_no_wait_that_nobody_can_end(
    module: ModuleType, act: Callable[[Any], object]
) -> None:
    """A reset brings the environment back, wherever it was, and takes no other's answer."""
    line = 0
    while True:
        env = SandboxVectorEnv(session_over(FakeLane()))
        came = before_line(module.__file__, line, lambda env=env: act(env))  # type: ignore[misc]
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
        assert layout is not None
        self.lane = LaneShard(layout, 0)
        self._changes = 0
        self._wishes: tuple[int, int] = (0, 0)

    def asked(self, dtype: str, slot: int) -> tuple[int, int, int]:
        """What it makes of a step: length of a message, code of the dtype, slot."""
        self.lane.ask([np.zeros(1, dtype)], slot, 0)
        words = inside.request_words(self.lane)
        if words[slabs.CHANGES] != self._changes:
            self._changes = words[slabs.CHANGES]
            self._wishes = words[slabs.DTYPES], words[slabs.SLOT]
        return words[slabs.MESSAGE], *self._wishes


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
                lane.ask([np.zeros(1, "int32")], 1, 0)
            else:
                lane.tell(b"packet", 1)

        came = before_line(shard.__file__, line, act)
        assert runner.asked(dtype, slot) == expected
        lane.close()
        if not came:
            break
        line += 1
    assert line > 4

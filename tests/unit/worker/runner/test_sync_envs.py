"""A sub-environment of LeRobot's rollouts, once its episode has ended."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from envhub_worker.runner.sync_envs import NEW_ROLLOUT, FreezingEnv, announces_rollout

ROLLOUT = {NEW_ROLLOUT: True}


class Counting:
    """Its episodes have two steps; it counts what is asked of it."""

    def __init__(self) -> None:
        self.resets = self.steps = self.renders = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.resets += 1
        return 0, {"seed": seed}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.steps, 1.0, self.steps % 2 == 0, False, {"at": self.steps}

    def render(self) -> Any:
        self.renders += 1
        return np.full((2, 2, 3), self.renders, np.uint8)


def test_what_has_ended_repeats_its_last_transition_without_reward() -> None:
    inner = Counting()
    env = FreezingEnv(inner)
    env.reset(seed=3, options=ROLLOUT)
    env.step(0)
    assert env.step(0) == (2, 1.0, True, False, {"at": 2})
    assert env.step(0) == env.step(1) == (2, 0.0, True, False, {"at": 2})
    assert env.reset() == (2, {"at": 2})
    assert (inner.steps, inner.resets) == (2, 1)
    assert env.reset(seed=4, options=ROLLOUT) == (0, {"seed": 4})
    assert env.step(0)[0] == 3


def test_a_frame_of_what_has_ended_is_drawn_once() -> None:
    inner = Counting()
    env = FreezingEnv(inner)
    env.reset(options=ROLLOUT)
    env.step(0)
    assert [int(env.render()[0, 0, 0]) for _ in range(2)] == [1, 2]
    env.step(0)
    assert [int(env.render()[0, 0, 0]) for _ in range(3)] == [3, 3, 3]
    env.reset(options=ROLLOUT)
    assert env.render()[0, 0, 0] == 4


@pytest.mark.parametrize("options", [None, {}, {NEW_ROLLOUT: False}, [NEW_ROLLOUT], NEW_ROLLOUT])
def test_other_options_announce_nothing(options: Any) -> None:
    assert announces_rollout(ROLLOUT)
    assert not announces_rollout(options)

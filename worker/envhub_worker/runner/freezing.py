"""Sub-environments of LeRobot's rollouts, which stand still once their episode has ended.

A rollout steps all sub-environments until the last one is done, and drops what the finished ones
give. Newer releases announce a rollout in the options of ``reset``. From then on a finished
sub-environment repeats its last transition, with reward 0, until the next rollout is announced; a
frame of it is drawn once. Followed: ``lerobot.envs.utils.FreezeAfterEpisodeEnd`` 0.6, around each
sub-environment, whose results these are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

NEW_ROLLOUT = "lerobot_new_rollout"
DRIVES = frozenset({"reset", "step", "render"})
"""What a ``FreezingEnv`` has of an environment."""


def announces_rollout(options: Any) -> bool:
    """Whether these options of a reset announce one of LeRobot's rollouts."""
    return isinstance(options, dict) and bool(options.get(NEW_ROLLOUT))


class FreezingEnv:
    """One sub-environment, as far as it is driven."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._last: Any = None
        self._frame: Any = None

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """As ``Env.reset``, but the last observation and info of what has ended."""
        if self._last is not None and not announces_rollout(options):
            return self._last[0], self._last[4]
        self._last = self._frame = None
        return self._env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """As ``Env.step``, but the last transition of what has ended."""
        if self._last is not None:
            return self._last
        result = self._env.step(action)
        observation, _, terminated, truncated, info = result
        if terminated or truncated:
            self._last = (observation, 0.0, terminated, truncated, info)
        return result

    def render(self) -> Any:
        """As ``Env.render``, but once of what has ended, if that is an image."""
        if self._frame is not None:
            return self._frame
        frame = self._env.render()
        if self._last is not None and isinstance(frame, np.ndarray):
            self._frame = frame
        return frame

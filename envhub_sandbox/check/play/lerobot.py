"""Whether LeRobot's policies can play an environment, by what its evaluation asks of one.

Followed: ``preprocess_observation`` of ``lerobot.envs.utils``, and ``rollout`` of ``lerobot_eval``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gymnasium import spaces
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import RemoteEnvError
from envhub_worker.protocol.text import printable

_SEEN = ("agent_pos", "environment_state", "pixels")
_LONGEST = 100


def lerobot_lacks(env: VectorEnv[Any, Any, Any]) -> Iterator[str]:
    """At most one text: what an evaluation by LeRobot would miss."""
    observations, actions = env.single_observation_space, env.single_action_space
    lacks = []
    if not isinstance(observations, spaces.Dict) or not {*_SEEN} & {*observations.spaces}:
        lacks.append(
            f"observations with {', '.join(_SEEN[:-1])} or {_SEEN[-1]}, not {_named(observations)}"
        )
    if not isinstance(actions, spaces.Box) or len(actions.shape) != 1:
        lacks.append(f"a vector (Box) as action, not {_named(actions)}")
    if not _has(env, "_max_episode_steps"):
        lacks.append("_max_episode_steps (gymnasium.wrappers.TimeLimit has it)")
    if lacks:
        yield f"LeRobot cannot evaluate it, which needs {'; '.join(lacks)}"


def _named(space: spaces.Space[Any]) -> str:
    """A space without the bounds of its numbers, of which there may be many."""
    if isinstance(space, spaces.Box):
        return f"a Box of shape {space.shape}"
    if isinstance(space, spaces.Dict):
        return f"a Dict of {printable(', '.join(map(str, space.spaces)), _LONGEST)}"
    return printable(str(space), _LONGEST)


def _has(env: Any, name: str) -> bool:
    try:
        env.get_attr(name)
    except (AttributeError, RemoteEnvError):
        return False
    return True

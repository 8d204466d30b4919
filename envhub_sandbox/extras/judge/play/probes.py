"""Probes of an environment: leaks of episodes, results of render, and the needs of LeRobot.

Leaks are counted from outside. The needs follow ``preprocess_observation`` of
``lerobot.envs.utils``, and ``rollout`` of ``lerobot_eval``.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

from gymnasium import spaces
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import RemoteEnvError
from envhub_sandbox.play.episodes import Episode
from envhub_sandbox.vector.pictures import is_frame
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.spaces.batches import shown
from envhub_worker.protocol.text import printable, size_text

_ROUNDS = 3
_LEAST = {
    "processes": ("leaks-processes", 2),
    "threads": ("leaks-threads", 2),
    "files": ("leaks-files", 2),
    "memory_bytes": ("leaks-memory", 1 << 20),
}
"""The check for each resource, and the least growth per round that counts: pools that fill once and
the allocator add less, or only once."""
LEAK_CHECKS = tuple(check for check, _ in _LEAST.values())

Usage = dict[str, int]


def usage_per_round(
    begin: Callable[[], Any], usage: Callable[[], Usage], resets: int, tell: Callable[[str], None]
) -> list[Usage]:
    """Returns the usage after each round of resets; the first warms up. Empty if nothing counts."""
    seen = []
    for number in range(_ROUNDS + 1):
        tell(f"{resets} resets, round {number + 1} of {_ROUNDS + 1}")
        for _ in range(resets):
            begin()
        seen.append(usage())
    return seen if all(seen) else []


def leak(seen: Sequence[Usage], resets: int) -> tuple[str, str] | None:
    """Returns the check for the resource that grew in every round, and a text; None if none grew.

    Reports only the first resource: a leftover process also has threads, memory and pipes, and a
    thread has a stack.
    """
    for what, (check, least) in _LEAST.items():
        counts = [usage[what] for usage in seen]
        steps = [after - before for before, after in itertools.pairwise(counts)]
        if steps and min(steps) >= least:
            name, words = ("memory", size_text) if what == "memory_bytes" else (what, str)
            return check, f"{name} after each {resets} resets: {', '.join(map(words, counts))}"
    return None


# --- results of render, compared with the requested mode -----------------------------------------

MODES = ("rgb_array", "rgb_array_list", "ansi")
"""Modes that need no display and have a known type of result."""

FILMED = ("rgb_array", "rgb_array_list")


def other_modes(env: VectorEnv[Any, Any, Any]) -> list[str]:
    """Returns the declared modes other than the current one. Trust: input from the worker."""
    declared = env.metadata.get("render_modes")
    declared_modes = declared if isinstance(declared, (list, tuple)) else ()
    named = {mode for mode in declared_modes if isinstance(mode, str)}
    return [mode for mode in MODES if mode in named and mode != env.render_mode]


def wrong_frames(env: VectorEnv[Any, Any, Any]) -> Iterator[str]:
    """Yields the first result of render that the mode does not permit."""
    mode = env.render_mode
    if mode not in MODES:
        return
    rendered = env.render()
    if not isinstance(rendered, (tuple, list)) or len(rendered) != env.num_envs:
        yield f"{mode}: render() gave {shown(rendered)}, not one result for each sub-environment"
        return
    for index, result in enumerate(rendered):
        if not _fits(result, mode):
            yield f"{mode}: sub-environment {index} gave {shown(result)}"
            return


def _fits(result: Any, mode: str) -> bool:
    if mode == "ansi":
        return isinstance(result, str)
    if mode == "rgb_array_list":
        return isinstance(result, (list, tuple)) and all(map(is_frame, result))
    return is_frame(result)


# --- the needs of LeRobot ------------------------------------------------------------------------

_SEEN = ("agent_pos", "environment_state", "pixels")
_PROCESSED = ("camera_obs", "policy", "robot_state")
"""Observation keys from which LeRobot's processors make the keys for its policies."""
_LONGEST = 100


def step_limit(env: Any) -> int | None:
    """Returns the declared limit of steps per episode. Trust: the worker's word."""
    stated = [getattr(env.spec, "max_episode_steps", None)]
    with contextlib.suppress(AttributeError, RemoteEnvError, TypeError):
        stated += env.get_attr("_max_episode_steps")
    return next((limit for limit in stated if type(limit) is int and limit > 0), None)


def lerobot_lacks(
    env: VectorEnv[Any, Any, Any], episodes: Sequence[Episode] = (), keys: Collection[str] = ()
) -> Iterator[str]:
    """Yields at most one text: the unmet needs of an evaluation by LeRobot.
    ``keys``: keys of infos at ends of episodes, which may report success under another name.
    """
    observations, actions = env.single_observation_space, env.single_action_space
    lacks = []
    if not isinstance(observations, spaces.Dict) or not (
        {*_SEEN, *_PROCESSED} & {*observations.spaces}
    ):
        lacks.append(
            f"observations with {', '.join(_SEEN[:-1])} or {_SEEN[-1]}, not {_named(observations)}"
        )
    if not isinstance(actions, spaces.Box) or len(actions.shape) != 1:
        lacks.append(f"a vector (Box) as action, not {_named(actions)}")
    if not has(env, "_max_episode_steps"):
        lacks.append("_max_episode_steps (gymnasium.wrappers.TimeLimit has it)")
    if episodes and all(episode.success is None for episode in episodes):
        alike = (key for key in keys if "succe" in key.lower() and not key.startswith("_"))
        others = ", ".join(sorted(map(repr, alike)))
        instead = f", not {printable(others, _LONGEST)}" if others else ""
        if "is_success" in keys:
            instead = " as a bool"
        lacks.append(f"info['is_success'] at the end of an episode{instead}")
    rate = getattr(env, "_manifest", env).metadata.get("render_fps")  # the repository's own value
    if env.render_mode in FILMED and rate is not None and not hasattr(rate, "numerator"):
        lacks.append(f"a whole number as metadata['render_fps'] for its videos, not {rate}")
    if lacks:
        yield f"LeRobot cannot evaluate it, which needs {'; '.join(lacks)}"


def _named(space: spaces.Space[Any]) -> str:
    """Describes a space without the bounds of its numbers, which may be many."""
    if isinstance(space, spaces.Box):
        return f"a Box of shape {space.shape}"
    if isinstance(space, spaces.Dict):
        return f"a Dict of {printable(', '.join(map(str, space.spaces)), _LONGEST)}"
    return printable(str(space), _LONGEST)


def has(env: Any, name: str) -> bool:
    """Tells whether the sub-environments or their wrappers have an attribute of that name."""
    try:
        env.get_attr(name)
    except (AttributeError, RemoteEnvError):
        return False
    return True


def is_statistics(env: Any, name: str) -> bool:
    """Tells whether the sub-environments' attribute is one of Gymnasium's running statistics."""
    try:
        [value, *_] = env.get_attr(name)
    except (AttributeError, RemoteEnvError, ValueError):
        return False
    kind = value.type_name if isinstance(value, RemoteObject) else type(value).__name__
    return kind.rpartition(".")[2] == "RunningMeanStd"

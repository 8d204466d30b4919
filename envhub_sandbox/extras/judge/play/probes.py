"""Single probes of an environment: what episodes leave behind, what render gives, LeRobot's needs.

Leaks are counted from outside. Followed for LeRobot: ``preprocess_observation`` of
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
"""The check of each, and what a round has to add: pools that are filled once, and the allocator,
add less or once."""
LEAK_CHECKS = tuple(check for check, _ in _LEAST.values())

Usage = dict[str, int]


def usage_per_round(
    begin: Callable[[], Any], usage: Callable[[], Usage], resets: int, tell: Callable[[str], None]
) -> list[Usage]:
    """What is held after each round of resets; a first round warms up. Empty if nothing counts."""
    seen = []
    for number in range(_ROUNDS + 1):
        tell(f"{resets} resets, round {number + 1} of {_ROUNDS + 1}")
        for _ in range(resets):
            begin()
        seen.append(usage())
    return seen if all(seen) else []


def leak(seen: Sequence[Usage], resets: int) -> tuple[str, str] | None:
    """The check of what grew in every round, and in what words; None if nothing did.

    A process that was left has threads and memory of its own, and pipes to it; a thread has a
    stack: only the first of them is reported.
    """
    for what, (check, least) in _LEAST.items():
        counts = [usage[what] for usage in seen]
        steps = [after - before for before, after in itertools.pairwise(counts)]
        if steps and min(steps) >= least:
            name, words = ("memory", size_text) if what == "memory_bytes" else (what, str)
            return check, f"{name} after each {resets} resets: {', '.join(map(words, counts))}"
    return None


# --- what render gives, held against the mode that it was asked in -------------------------------

MODES = ("rgb_array", "rgb_array_list", "ansi")
"""Those that need no display, and of which one knows what they give."""

FILMED = ("rgb_array", "rgb_array_list")


def other_modes(env: VectorEnv[Any, Any, Any]) -> list[str]:
    """The modes that it declares and is not in. Trust: input from the worker."""
    declared = env.metadata.get("render_modes")
    declared_modes = declared if isinstance(declared, (list, tuple)) else ()
    named = {mode for mode in declared_modes if isinstance(mode, str)}
    return [mode for mode in MODES if mode in named and mode != env.render_mode]


def wrong_frames(env: VectorEnv[Any, Any, Any]) -> Iterator[str]:
    """What its mode does not permit, of the first sub-environment that gives it."""
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


# --- what LeRobot needs --------------------------------------------------------------------------

_SEEN = ("agent_pos", "environment_state", "pixels")
_PROCESSED = ("camera_obs", "policy", "robot_state")
"""Observation keys from which LeRobot's processors make those that its policies see."""
_LONGEST = 100


def step_limit(env: Any) -> int | None:
    """The steps after which it says that it ends an episode. Trust: the worker's word."""
    stated = [getattr(env.spec, "max_episode_steps", None)]
    with contextlib.suppress(AttributeError, RemoteEnvError, TypeError):
        stated += env.get_attr("_max_episode_steps")
    return next((limit for limit in stated if type(limit) is int and limit > 0), None)


def lerobot_lacks(
    env: VectorEnv[Any, Any, Any], episodes: Sequence[Episode] = (), keys: Collection[str] = ()
) -> Iterator[str]:
    """At most one text: what an evaluation by LeRobot would miss.
    ``keys``: of infos at ends of episodes, which may tell a success by another name.
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
        lacks.append(f"info['is_success'] at the end of an episode{instead}")
    rate = getattr(env, "_manifest", env).metadata.get("render_fps")  # as the repository has it
    if env.render_mode in FILMED and rate is not None and not hasattr(rate, "numerator"):
        lacks.append(f"a whole number as metadata['render_fps'] for its videos, not {rate}")
    if lacks:
        yield f"LeRobot cannot evaluate it, which needs {'; '.join(lacks)}"


def _named(space: spaces.Space[Any]) -> str:
    """A space without the bounds of its numbers, of which there may be many."""
    if isinstance(space, spaces.Box):
        return f"a Box of shape {space.shape}"
    if isinstance(space, spaces.Dict):
        return f"a Dict of {printable(', '.join(map(str, space.spaces)), _LONGEST)}"
    return printable(str(space), _LONGEST)


def has(env: Any, name: str) -> bool:
    """Whether its sub-environments have an attribute of that name, or a wrapper around them."""
    try:
        env.get_attr(name)
    except (AttributeError, RemoteEnvError):
        return False
    return True


def is_statistics(env: Any, name: str) -> bool:
    """Whether this attribute of the sub-environments is one of Gymnasium's running statistics."""
    try:
        [value, *_] = env.get_attr(name)
    except (AttributeError, RemoteEnvError, ValueError):
        return False
    kind = value.type_name if isinstance(value, RemoteObject) else type(value).__name__
    return kind.rpartition(".")[2] == "RunningMeanStd"

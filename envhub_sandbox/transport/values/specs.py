"""An ``EnvSpec`` of which a worker says only facts: it makes nothing.

Trust: the facts are input from the worker.
"""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

_REFUSAL = f"{__name__}:not_here"


def spec_of(given: dict[str, Any] | None, reference: str = "") -> EnvSpec | None:
    """A spec with these facts, as ``read_spec_facts`` lets them through.

    A string names what refuses, so that it can be written as JSON like any other.

    Args:
        given: ``id``, ``max_episode_steps``, ``reward_threshold``, ``nondeterministic``.
        reference: The repository, for the text of the refusal.
    """
    # gym.make imports what stands before a colon
    if given is None or given.get("id") is None or ":" in given["id"]:
        return None
    facts = {name: value for name, value in given.items() if value is not None}
    try:
        return EnvSpec(
            **facts,
            entry_point=_REFUSAL,
            vector_entry_point=_REFUSAL,
            kwargs={"reference": reference} if reference else {},
        )
    except Exception:  # an id that this Gymnasium cannot read: not worth failing for
        return None


def not_here(*args: Any, reference: str = "", **kwargs: Any) -> NoReturn:
    """What ``gym.make(env.spec)`` calls.

    Raises:
        gymnasium.error.Error: Always.
    """
    where = f", {reference}" if reference else ""
    raise gym.error.Error(
        f"this is of an environment in a sandbox{where}: to make one here would need its code "
        "in this process, which it never enters. Use envhub_sandbox.make_env with that repository, "
        "or copy.deepcopy(env) for another one like it"
    )

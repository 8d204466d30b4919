"""Spaces, specs and generators that a worker describes in an answer, made here of plain values.

Trust: every description is input from the worker. Nothing of the worker's is executed: what comes
is fields of a fixed form, each held against what such a thing can have.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.transport.values.generators import generator
from envhub_sandbox.transport.values.tensors import to_tensor
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject, one_line
from envhub_worker.protocol.codec.kinds import GENERATOR, SPACE, SPEC, Buffer
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.manifest.facts import read_spec_facts
from envhub_worker.protocol.spaces.reader import (
    ELEMENT_BYTES,
    GENERATOR_BYTES,
    SPACE_BYTES,
    SpaceReader,
)


def unpacked(frames: Sequence[Buffer], limits: WireLimits = DEFAULT_LIMITS) -> m.Message:
    """A runner's message, with what it describes. Trust: input from the worker.

    Raises:
        RemoteProtocolError: It is none.
    """
    return m.unpack(frames, limits=limits, tensors=to_tensor, things=DescriptionReader)


_REFUSAL = f"{__name__}:not_here"
_SPEC_TYPE = "gymnasium.envs.registration.EnvSpec"
_SHOWN = 200


class DescriptionReader:
    """What one message describes, out of one budget: all of it costs no more than its bytes may.

    Args:
        limits: What the message may hold.
    """

    def __init__(self, limits: WireLimits) -> None:
        self._reader = SpaceReader(limits.message_bytes // ELEMENT_BYTES, generator=generator)

    def __call__(self, code: int, value: object) -> object:
        """The thing that is described. Trust: input from the worker.

        Raises:
            RemoteProtocolError: There can be none like it, or it costs too much.
        """
        if code == SPACE:
            return self._reader.space(value)
        if code == SPEC:
            self._reader.spend(SPACE_BYTES)
            return _spec(value)
        if code == GENERATOR:
            self._reader.spend(GENERATOR_BYTES)
            return generator(value)
        raise RemoteProtocolError(f"nothing is described by {code}")


def _spec(value: object) -> Any:
    """A spec; a description of one whose id this Gymnasium cannot read."""
    facts = read_spec_facts(value)
    made = spec_of(facts)
    return RemoteObject(_SPEC_TYPE, one_line(str(facts), _SHOWN)) if made is None else made


def spec_of(given: dict[str, Any] | None, reference: str = "") -> EnvSpec | None:
    """A spec with these facts, as ``read_spec`` lets them through.

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
        f"this describes an environment in a sandbox{where}, whose code never enters this process. "
        "Use envhub_sandbox.make_env with that repository, or copy.deepcopy(env) for a copy"
    )

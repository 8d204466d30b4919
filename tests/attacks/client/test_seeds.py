"""States of spaces' generators in a manifest that lies: checked, bounded, or refused.

Control: numpy itself takes them, or the same manifest without the lie is taken.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.transport.values import generator
from envhub_worker.protocol.manifest.manifest import (
    EnvManifest,
    Manifest,
    decode_manifest,
    encode_manifest,
)
from tests.attacks.client.lies import STATES, mt19937
from tests.attacks.client.lying_server import env_manifest

ELEMENTS = 100_000


def described(space: Any = None) -> dict[str, Any]:
    """An honest manifest with a seeded space."""
    space = spaces.Discrete(1000, seed=5) if space is None else space
    env: EnvManifest = env_manifest(single_action_space=space)
    return encode_manifest(Manifest(envs=(env,), lazy=True))


def space_of(value: Any) -> dict[str, Any]:
    found: dict[str, Any] = value["envs"][0]["single_action_space"]
    return found


def read(value: object, elements: int = ELEMENTS) -> Manifest:
    return decode_manifest(value, max_elements=elements, generator=generator)


def state(**fields: Any) -> dict[str, Any]:
    honest = dict(np.random.PCG64(5).state)
    return {**honest, **fields}


LIES: dict[str, Any] = {
    **{what: [lie] for what, lie in STATES.items() if lie is not None},  # None: there is none
    "no list": {"bit_generator": "PCG64"},
    "too few": [],
    "too many": [None] * 100_000,
    "its own place": [0],
    "a place before it": [-1],
    "a class": [state(bit_generator="Generator")],
    "a field too many": [state(more=1)],
    "a huge integer": [state(state={"state": 1 << 8000, "inc": 1})],
    "an integer of numpy's": [state(uinteger=np.int64(1))],
    "a huge key": [mt19937(key=np.zeros(1 << 20, np.uint32))],
}


def test_the_honest_one_is_taken() -> None:
    found = read(described()).envs[0].single_action_space
    assert [found.sample() for _ in range(5)] == [
        drawn.sample() for drawn in [spaces.Discrete(1000, seed=5)] for _ in range(5)
    ]


@pytest.mark.parametrize("lie", LIES)
def test_a_state_that_there_cannot_be_is_refused(lie: str) -> None:
    value = described()
    assert space_of(value)["generators"]
    space_of(value)["generators"] = LIES[lie]
    with pytest.raises(RemoteProtocolError):
        read(value)


def test_generators_cost_what_spaces_do() -> None:
    """Many small spaces with one each do not fit a budget that they fit without."""
    value = described(spaces.Tuple([spaces.Discrete(2, seed=i) for i in range(100)]))
    bare = described(spaces.Tuple([spaces.Discrete(2, seed=i) for i in range(100)]))
    del space_of(bare)["generators"]
    read(bare, 15_000)
    with pytest.raises(RemoteProtocolError, match="cost more"):
        read(value, 15_000)


def test_one_inside_of_a_space_is_refused() -> None:
    value = described(spaces.Tuple([spaces.Discrete(2, seed=1)]))
    inner = space_of(value)["spaces"][0]
    inner["generators"] = [state()]
    with pytest.raises(RemoteProtocolError, match="wrong attributes"):
        read(value)

"""A handle on one sub-environment, and a worker that answers as it likes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.vector.sub_environment import SubEnvironment
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject


def one_of_two(value: object) -> SubEnvironment:
    """The first of two, of which everything is the same."""
    space = spaces.Discrete(2)
    vector: Any = SimpleNamespace(num_envs=2, single_observation_space=space)
    manifest: Any = SimpleNamespace(sync=True, shardable=True)
    return SubEnvironment(vector, manifest, lambda name, index, message: m.Value(value), 0)


def test_wrappers_without_end_are_refused() -> None:
    env: Any = one_of_two(RemoteObject("gymnasium.Wrapper", "<Wrapper>"))
    wrappers = 0
    with pytest.raises(RemoteProtocolError, match="wrap one"):  # noqa: PT012
        while hasattr(env, "env"):
            env, wrappers = env.env, wrappers + 1
    assert wrappers == 1000
    assert isinstance(env.unwrapped, SubEnvironment)


def test_what_is_neither_true_nor_false_breaks_the_rules() -> None:
    assert one_of_two(1).has_wrapper_attr("a") is True
    with pytest.raises(RemoteProtocolError):
        one_of_two(np.zeros(2)).has_wrapper_attr("a")

"""Which values are in a space, for ``validate=True``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from envhub_sandbox.vector.validated import holds
from envhub_worker.protocol.spaces.spaces import OpaqueSpace


def test_holds_counts_numbers_as_what_they_are_worth() -> None:
    """Not by their dtype, as ``contains`` does."""
    box = gym.spaces.Box(0, 1, (2,), np.float32)
    nested = gym.spaces.Dict(a=gym.spaces.Tuple([box, gym.spaces.Discrete(3)]))
    good = {"a": (np.array([0.0, 1.0]), np.int64(2))}
    assert holds(nested, good)
    assert not holds(nested, {"a": (good["a"][0], np.int64(3))})
    assert not holds(nested, {"a": good["a"][:1]})
    assert not holds(nested, {"b": good["a"]})
    assert not holds(box, np.array(["0", "1"]))
    assert holds(OpaqueSpace("their.Space", "Space()"), object())

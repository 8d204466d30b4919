"""The info of one sub-environment, out of those of all."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.vector import VectorEnv

from envhub_sandbox.vector.infos import info_of


@pytest.mark.parametrize("index", range(3))
def test_it_is_the_other_way_round_from_gymnasiums(index: int) -> None:
    """What a sub-environment has put in comes out again, and nothing of the others."""
    env: VectorEnv[object, object, object] = VectorEnv()
    env.num_envs = 3
    infos = [{"a": 1, "deep": {"b": 0.5}}, {"c": "text", 7: 2}, {}]
    joined: dict[object, object] = {}
    for number, info in enumerate(infos):
        joined = env._add_info(joined, info, number)
    found = info_of(joined, index, 3)
    assert {key: value for key, value in found.items() if value != {}} == infos[index]


def test_what_is_the_vectors_own_is_everyones() -> None:
    """Without a mask, and of another length."""
    assert info_of({"a": np.arange(5), "b": "all"}, 0, 3)["b"] == "all"
    assert info_of({"a": np.arange(5)}, 0, 3)["a"].tolist() == [0, 1, 2, 3, 4]

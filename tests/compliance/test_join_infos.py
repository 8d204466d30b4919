"""Infos that come from several shards are what one vector environment would have made of them.
Except where sub-environments disagree about a key's dtype: Gymnasium casts to the first one's, and
each shard has a first one of its own."""

import itertools
import warnings
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.spaces.batches import join_infos
from tests.support.compare import assert_same

VALUES: dict[str, st.SearchStrategy[Any]] = {
    "int": st.integers(-9, 9),
    "float": st.floats(allow_nan=True, width=32),
    "bool": st.booleans(),
    "text": st.text(max_size=3),
    "none": st.none(),
    "list": st.lists(st.integers(), max_size=2),
    "array": st.integers(0, 9).map(lambda n: np.full((2, 2), n, np.int16)),
    "words": st.sampled_from(["abc", "cde"]).map(lambda word: np.array([word])),
    "objects": st.integers(0, 9).map(lambda n: np.array([n, None], dtype=object)),
    "final_obs": st.integers(0, 9).map(lambda n: np.array([n])),
    "mixed": st.one_of(st.text(max_size=2), st.none(), st.lists(st.text(), max_size=1)),
}
FLAT = st.fixed_dictionaries({}, optional=VALUES)
INFO = st.fixed_dictionaries({}, optional={**VALUES, "nested": FLAT, "deep": st.just({"a": {}})})


def added(infos: list[dict[str, Any]]) -> dict[str, Any]:
    env: VectorEnv[Any, Any, Any] = VectorEnv()
    env.num_envs = len(infos)
    joined: dict[str, Any] = {}
    for index, info in enumerate(infos):
        joined = env._add_info(joined, info, index)
    return joined


@given(st.lists(INFO, min_size=1, max_size=6), st.data())
def test_shards_join_as_one_batch(infos: list[dict[str, Any]], data: st.DataObject) -> None:
    """However the sub-environments are cut into shards, the joined infos are Gymnasium's."""
    cuts = data.draw(st.sets(st.integers(1, max(1, len(infos) - 1))))
    edges = [0, *sorted(cut for cut in cuts if cut < len(infos)), len(infos)]
    shards = [infos[start:stop] for start, stop in itertools.pairwise(edges)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        expected = added(infos)
        assert_same(expected, join_infos([added(s) for s in shards], [len(s) for s in shards]))

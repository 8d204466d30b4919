"""``copy=False``: observations that are lent, and still never change under whoever holds them."""

import mmap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.transport.shared_memory.client_slabs import RING
from tests.support.compare import assert_same
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample

STEPS = 40


def rollout(keep: int, *, copy: bool, num_workers: int) -> tuple[list[Any], list[Any]]:
    """Observations as they were when they came, and as they are at the end, for those kept."""
    with make_env(
        sample("counter"), n_envs=3, use_async_envs=True, copy=copy, num_workers=num_workers
    ) as suites:
        env = suites.env
        env.reset(seed=3)
        env.action_space.seed(3)
        seen, kept = [], []
        for _ in range(STEPS):
            observation = env.step(env.action_space.sample())[0]
            seen.append(_copied(observation))
            kept.append(observation)
            if len(kept) > keep:
                kept.pop(0)
            del observation
        return seen, kept


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return tuple(map(_copied, value))
    return np.array(value)


@pytest.mark.parametrize(("keep", "num_workers"), [(1, 1), (RING, 3), (RING + 3, 1), (STEPS, 1)])
def test_what_is_held_never_changes(keep: int, num_workers: int) -> None:
    """However many batches a caller keeps, each stays as it was when it came; and is what it is
    where the caller owns it."""
    lent, kept = rollout(keep, copy=False, num_workers=num_workers)
    assert_same(lent[-len(kept) :], [_copied(observation) for observation in kept])
    owned, _ = rollout(keep, copy=True, num_workers=num_workers)
    assert_same(owned, lent)


def test_batches_are_lent_where_they_lie() -> None:
    """As long as there are slots that nobody holds; then they are copied, until one is free. A
    slice that outlives its array holds its slot, too; closing gives no memory back that is read."""
    with make_env(sample("cartpole"), n_envs=2, copy=False) as suites:
        env = suites.env
        env.reset(seed=1)
        held = [env.step([0, 1])[0] for _ in range(RING)]
        assert all(isinstance(observation.base, mmap.mmap) for observation in held)
        assert len({id(observation.base) for observation in held}) == RING
        assert env.step([0, 1])[0].base is None
        slot = id(held.pop(0).base)
        assert id(env.step([0, 1])[0].base) == slot
        held.clear()
        rows = [env.step([0, 1])[0][1, 1:3] for _ in range(3 * RING)]
        values = [row.copy() for row in rows]
        for _ in range(3 * RING):
            env.step([1, 0])
    np.testing.assert_array_equal(rows, values)


def test_what_has_no_elements_is_lent_like_the_rest(tmp_path: Path) -> None:
    empty = """
class Empty(Still):
    observation_space = gym.spaces.Box(-1, 1, (0, 2))

    def reset(self, **options):
        return np.zeros((0, 2)), {}

    def step(self, action):
        return np.zeros((0, 2)), 0.0, False, False, {}
"""
    with make_env(write_repository(tmp_path, STILL + empty), n_envs=2, copy=False) as suites:
        env = suites.env
        batches = [env.reset()[0], *(env.step([0, 1])[0] for _ in range(RING))]
    assert {(batch.shape, batch.dtype.name) for batch in batches} == {((2, 0, 2), "float32")}

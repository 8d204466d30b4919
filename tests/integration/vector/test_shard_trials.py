"""Uses of one pin that are cut in different ways, and give the same."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.transport import shard_trials
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.repositories import write_repository
from tests.support.samples import sample

N_ENVS = 4
WAYS = [[(0, 2), (2, 4)], [(0, 3), (3, 4)], [(0, 4)]]
STEPS = shard_trials.LEAST_STEPS


@pytest.fixture
def repository(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A pin that nobody has used, which is cut in three ways: a busy machine may lack the time to
    see that the sub-environments are independent."""
    monkeypatch.setattr(shard_trials, "ways_to_cut", lambda count, cores: WAYS)
    monkeypatch.setattr(shard_trials.ShardTrials, "may_share", lambda self, env: True)
    code = (sample("cartpole") / "env.py").read_text()
    return write_repository(tmp_path, f"# {tmp_path}\n{code}")


def use(repository: Path, lane: str, steps: int) -> tuple[list[tuple[int, int]], list[Any]]:
    """How it was cut, and all that it gave."""
    with make_env(repository, N_ENVS, use_async_envs=True, policy={"lane": lane}) as suites:
        env = suites.env
        found: list[Any] = [env.reset(seed=3)]
        found += [env.step(np.arange(N_ENVS) % 2) for _ in range(steps)]
        return inside.bounds(env), found


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_the_first_uses_try_all_ways_and_give_the_same(
    repository: Path, lane: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows, seeds, order and infos; a use that is too short to be measured is repeated."""
    monkeypatch.setattr(shard_trials, "HOPELESS", float("inf"))
    assert use(repository, lane, STEPS - 1)[0] == WAYS[0]
    uses = [use(repository, lane, STEPS) for _ in WAYS]
    assert [bounds for bounds, _ in uses] == WAYS
    for _, found in uses[1:]:
        assert_same(found, uses[0][1])
    assert use(repository, lane, 0)[0] in WAYS


def test_what_is_never_closed_counts(repository: Path) -> None:
    """A training may be killed: after enough steps it is noted what they took."""
    with make_env(repository, N_ENVS, use_async_envs=True) as suites:
        suites.env.reset(seed=3)
        for left in range(shard_trials.ENOUGH_STEPS, 0, -1):
            if left == 1:
                assert use(repository, "auto", 0)[0] == WAYS[0]
            suites.env.step(np.zeros(N_ENVS, np.int64))
        assert use(repository, "auto", 0)[0] == WAYS[1]

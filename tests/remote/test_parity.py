"""The compliance suite against a server over TCP, with keys: the same, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.transport.shared_memory.served_lane import ServedLane
from tests.compliance.conftest import pytest_generate_tests as pytest_generate_tests
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance, cases, paired
from tests.remote.listening import Listening
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.objects.pipelines import changing, one_by_one, several_at_once
from tests.support.started import started


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, server: Listening) -> Iterator[Pair]:
    """The reference here and the environment over there; a class's tests share them."""
    with paired(request.cls.sample, case, sandbox=server.sandbox()) as both:
        yield both


@pytest.mark.short
class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos, over two processes."""

    sample = "counter"
    cases = cases(use_async_envs=(True,), modes=("NextStep",))
    steps = 60


class TestCartPole(VectorEnvCompliance):
    """Discrete actions, float32 observations."""

    sample = "cartpole"
    cases = cases(n_envs=(4,), use_async_envs=(False,), modes=("SameStep",))
    steps = 300


@pytest.mark.short
class TestExoticSpaces(VectorEnvCompliance):
    """Spaces that have no fixed layout."""

    sample = "exotic_spaces"
    cases = cases(n_envs=(2,), use_async_envs=(False,), modes=("Disabled",))
    steps = 40


class TestLeRobotPendulum(VectorEnvCompliance):
    """Dict observations and ``is_success`` in every info."""

    sample = "lerobot_pendulum"
    cases = cases(n_envs=(2,), use_async_envs=(False,), modes=("NextStep",))


@pytest.mark.parametrize("size", [3, 100_000])
def test_several_steps_on_their_way_are_the_same_steps(
    server: Listening, tmp_path: Path, size: int
) -> None:
    """Sent before the last has been received, they give what they give one by one; also where infos
    do not fit or change their columns, and where one raises."""
    folder = changing(tmp_path, size)
    took: list[bool] = []
    with started(folder, 2, num_workers=1, sandbox=server.sandbox()) as env:
        expected = one_by_one(env)
    with started(folder, 2, num_workers=1, sandbox=server.sandbox()) as env:
        lane = inside.session(env).lease.lane
        assert isinstance(lane, ServedLane)
        results = several_at_once(env, lambda: took.append(lane.takes_more))
    assert set(took) == {True, False}, "some through slabs, and some as messages"
    for number, ((wanted, _), (came, _)) in enumerate(zip(expected, results, strict=True)):
        assert_same(wanted, came, f"step {number}")

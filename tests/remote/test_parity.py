"""The compliance suite against a server over TCP, with keys: the same, bit for bit."""

from collections.abc import Iterator

import pytest

from tests.compliance.conftest import pytest_generate_tests as pytest_generate_tests
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance, cases, paired
from tests.remote.listening import Listening


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, server: Listening) -> Iterator[Pair]:
    with paired(request.cls.sample, case, sandbox=server.sandbox()) as both:
        yield both


@pytest.mark.short
class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos, over two processes."""

    sample = "counter"
    cases = cases(use_async_envs=(True,), modes=("NextStep",))
    steps = 60


class TestExoticSpaces(VectorEnvCompliance):
    """Spaces that have no fixed layout."""

    sample = "exotic_spaces"
    cases = cases(n_envs=(2,), use_async_envs=(False,), modes=("Disabled",))
    steps = 40


class TestLeRobotPendulum(VectorEnvCompliance):
    """Dict observations and ``is_success`` in every info."""

    sample = "lerobot_pendulum"
    cases = cases(n_envs=(2,), use_async_envs=(False,), modes=("NextStep",))

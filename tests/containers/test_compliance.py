"""An environment in a container is the same as the one in process, over both lanes."""

from collections.abc import Iterator

import pytest

from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance, cases, paired
from tests.support import inside


@pytest.fixture(scope="class")
def pair(
    request: pytest.FixtureRequest, case: Case, lane: str, docker: DockerSandbox
) -> Iterator[Pair]:
    with paired(request.cls.sample, case, policy={"lane": lane}, sandbox=docker) as both:
        yield both


class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos, in two processes."""

    sample = "counter"
    cases = cases(use_async_envs=(True,), modes=("NextStep",))
    steps = 100

    def test_lane_is_the_one_that_was_asked_for(self, pair: Pair, lane: str) -> None:
        """Descriptors cross the container's wall: memory is shared with the jail itself."""
        pair.reset(seed=1)
        in_use = inside.lane(pair.sandboxed) is not None
        assert in_use is (lane == "auto")

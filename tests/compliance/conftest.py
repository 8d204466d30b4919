"""How the suite reaches the environments that it checks."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from envhub_sandbox import make_env
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance
from tests.support.samples import reference, sample


@pytest.fixture(scope="session", params=["auto", "frames"])
def lane(request: pytest.FixtureRequest) -> str:
    """How steps travel: ``"auto"`` over shared memory where it can be, ``"frames"`` never."""
    return str(request.param)


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, lane: str) -> Iterator[Pair]:
    """The reference and the sandboxed environment of a case; its tests share them."""
    suite: type[VectorEnvCompliance] = request.cls
    expected = reference(suite.sample, case.n_envs, **case.env_kwargs)
    suites = make_env(
        sample(suite.sample),
        n_envs=case.n_envs,
        use_async_envs=case.use_async_envs,
        env_kwargs=case.env_kwargs,
        num_workers=case.num_workers,
        lane=lane,
    )
    with suites:
        yield Pair(expected, suites.env)
    expected.close()


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test of a suite once for each of its class's cases."""
    cases: list[Case] | None = getattr(metafunc.cls, "cases", None)
    if cases and "case" in metafunc.fixturenames:
        metafunc.parametrize("case", cases, ids=[case.label for case in cases], scope="class")

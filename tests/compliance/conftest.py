"""How the suite reaches the environments that it checks."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, paired


@pytest.fixture(scope="session", params=["auto", "frames"])
def lane(request: pytest.FixtureRequest) -> str:
    """How steps travel: ``"auto"`` over shared memory where it can be, ``"frames"`` never."""
    return str(request.param)


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, lane: str) -> Iterator[Pair]:
    """The reference and the sandboxed environment of a case; its tests share them."""
    with paired(request.cls.sample, case, lane=lane) as both:
        yield both


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test of a suite once for each of its class's cases."""
    cases: list[Case] | None = getattr(metafunc.cls, "cases", None)
    if cases and "case" in metafunc.fixturenames:
        metafunc.parametrize("case", cases, ids=[case.label for case in cases], scope="class")

"""How the suite reaches the environments that it checks."""

from collections.abc import Iterator

import pytest

from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, paired


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, lane: str) -> Iterator[Pair]:
    """The reference and the sandboxed environment of a case; its tests share them."""
    with paired(request.cls.sample, case, policy={"lane": lane}) as both:
        yield both


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test of a suite once for each of its class's cases, and of each lane.
    ``lane`` is how steps travel: ``"auto"`` over shared memory where it can be, ``"frames"`` never.
    All cases go the first way, the class's last ones both."""
    cases: list[Case] | None = getattr(metafunc.cls, "cases", None)
    marks = metafunc.definition.iter_markers("parametrize")
    chosen = any("lane" in mark.args[0] for mark in marks)
    is_laned = "lane" in metafunc.fixturenames and not chosen
    if cases and "case" in metafunc.fixturenames:
        ways = [(case, "auto") for case in cases]
        if is_laned:
            ways += [(case, "frames") for case in cases[-metafunc.cls.over_frames :]]
            ids = [f"{lane}-{case.label}" for case, lane in ways]
            metafunc.parametrize(("case", "lane"), ways, ids=ids, scope="class")
        else:
            metafunc.parametrize("case", cases, ids=[case.label for case in cases], scope="class")
    elif is_laned:
        metafunc.parametrize("lane", ["auto", "frames"])

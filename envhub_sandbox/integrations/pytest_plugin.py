"""A pytest plugin for authors: ``pytest --envhub-ref .``, and the fixture ``envhub_env``.

pytest imports it in every run on a machine that has this package, so it imports nothing but pytest
before a test asks for the fixture.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

_MARK = "envhub"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option ``--envhub-ref``."""
    group = parser.getgroup("envhub", "environments of the Hugging Face Hub, in a sandbox")
    group.addoption(
        "--envhub-ref",
        metavar="REF",
        help="What the fixture envhub_env makes: a hub reference, or a folder, './my-env'.",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Add the marker with the fixture's options."""
    config.addinivalue_line(
        "markers",
        f"{_MARK}(suite=, task=, **options): which environment envhub_env is, and further "
        "arguments of make_env for it, such as n_envs=2.",
    )


@pytest.fixture
def envhub_env(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Make the vector environment of ``--envhub-ref`` in a sandbox, for one test."""
    __tracebackhide__ = True  # an error shows the repository's code, and none of ours
    ref = request.config.getoption("--envhub-ref")
    if ref is None:
        pytest.fail("the fixture envhub_env needs --envhub-ref REF, as in --envhub-ref .")
    from envhub_sandbox.factory.make_env import make_env
    from envhub_sandbox.vector.suites import choose

    marks = request.node.iter_markers(_MARK)
    options: dict[str, Any] = {}
    for mark in reversed(list(marks)):  # the nearest marker is last and wins
        options |= mark.kwargs
    chosen = options.pop("suite", None), options.pop("task", None)
    with make_env(_from_where_pytest_began(ref, request), **options) as suites:
        yield choose(suites, *chosen)


def _from_where_pytest_began(ref: str, request: pytest.FixtureRequest) -> str:
    """Make a folder's path absolute, because a test may have changed the working directory."""
    from envhub_sandbox.hub.reference import is_local

    began = request.config.invocation_params.dir
    return str(began / ref) if is_local(ref) and not ref.startswith(("~", "examples:")) else ref

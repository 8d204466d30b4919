"""Ctrl-C anywhere in a start or in a close: nothing is left, and what follows is as ever.

Python looks for signals where a function begins, so these are the moments that are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from envhub_sandbox import make_env
from tests.support.in_process.interrupts import at_call
from tests.support.samples import sample
from tests.support.started import nothing_more_held

pytestmark = [
    pytest.mark.same_for("users"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

_STARTS, _CLOSES = 61, 17
"""Calls between two moments: of some 500 in a start, and of some 120 in a close."""
_WAYS: dict[str, dict[str, Any]] = {
    "auto": {"use_async_envs": True},
    "frames": {"use_async_envs": True, "lane": "frames"},
    "fleet": {"n_envs": 6, "sandbox": ["process"] * 3},
}
ways = pytest.mark.parametrize("way", _WAYS)


@pytest.fixture
def nothing_more() -> Iterator[Callable[[], bool]]:
    """Whether nothing is held beyond what one environment does, which runs beside those tried."""
    with nothing_more_held() as question:
        yield question


def _made(way: str) -> Any:
    return make_env(sample("echo"), **{"n_envs": 2, **_WAYS[way]})


@ways
def test_an_interrupted_start_leaves_nothing_behind(
    nothing_more: Callable[[], bool], way: str
) -> None:
    """No use of the server, no jail, no descriptor; and what the next reset says is its own."""
    options = {"token": 5.0, "delay": 0.0}
    moment, came = 0, True
    while came:
        with _made(way) as suites:
            came = at_call(moment, suites.env.reset)
            observations, _ = suites.env.reset(options=options)
            assert observations.tolist() == [[5.0, 0.0]] * suites.env.num_envs
        assert nothing_more(), moment
        moment += _STARTS
    assert moment > 3 * _STARTS


@ways
def test_an_interrupted_close_leaves_nothing_behind(
    nothing_more: Callable[[], bool], way: str
) -> None:
    """No use of the server, no jail, no descriptor, once it is closed again, or nobody has it."""
    moment, came = 0, True
    while came:
        suites = _made(way)
        suites.env.reset()
        came = at_call(moment, suites.close)
        if moment % 2:
            suites.close()
            assert nothing_more(), moment
        del suites
        assert nothing_more(), moment
        moment += _CLOSES
    assert moment > 3 * _CLOSES

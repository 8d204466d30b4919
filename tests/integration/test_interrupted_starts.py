"""Ctrl-C anywhere in a start: nothing is left running or open, and the next reset starts afresh.

Python looks for signals where a function begins, so these are the moments that are tried.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import envhub_sandbox
from envhub_sandbox import make_env
from tests.support import inside
from tests.support.processes import eventually
from tests.support.samples import sample

_OURS = str(Path(envhub_sandbox.__file__).parent)
_EVERY = 41
"""Calls between two moments: of some 1,200 in a start."""


def interrupted(moment: int, act: Callable[[], object]) -> bool:
    """Do it, with a Ctrl-C at the ``moment``-th call of the client's own; whether there is one.

    One that comes into a finaliser is printed, and goes no further.
    """
    left = moment

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal left
        if frame.f_code.co_filename.startswith(_OURS):
            left -= 1
            if left < 0:
                sys.settrace(None)
                raise KeyboardInterrupt

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        act()
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(before)
    return left < 0


def _descriptors() -> int:
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


@pytest.fixture
def server() -> Iterator[Any]:
    """The server of an environment that runs beside those that are interrupted."""
    with make_env(sample("echo"), n_envs=2) as suites:
        suites.env.reset()
        yield inside.server(suites.env)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_an_interrupted_start_leaves_nothing_behind(server: Any, lane: str) -> None:
    """No use of the server, no descriptor; and what the next reset says is its own."""
    options = {"token": 5.0, "delay": 0.0}
    moment, users, before, came = 0, server.users, _descriptors(), True
    while came:
        with make_env(sample("echo"), n_envs=2, use_async_envs=True, lane=lane) as suites:
            came = interrupted(moment, suites.env.reset)
            observations, _ = suites.env.reset(options=options)
            assert observations.tolist() == [[5.0, 0.0]] * 2
        assert server.users == users, moment
        moment += _EVERY
    assert eventually(lambda: _descriptors() <= before)
    assert moment > 5 * _EVERY

"""An environment that is made, reset and in the end closed: what most tests begin with."""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from envhub_sandbox import make_env
from tests.support import inside
from tests.support.processes import eventually
from tests.support.samples import sample


@contextmanager
def started(*arguments: Any, seed: int | None = 1, **options: Any) -> Iterator[Any]:
    """The environment of what ``make_env`` makes of these arguments, after a reset."""
    with make_env(*arguments, **options) as suites:
        suites.env.reset(seed=seed)
        yield suites.env


@contextmanager
def nothing_more_held() -> Iterator[Callable[[], bool]]:
    """Whether nothing is held beyond what one environment does, which runs meanwhile: uses of its
    server and jails in it, and descriptors of ours."""
    with started(sample("echo"), n_envs=2) as env:

        def held() -> tuple[int, int, int]:
            gc.collect()
            return inside.users(env), inside.jails(env), len(os.listdir("/proc/self/fd"))

        before = held()
        yield lambda: eventually(
            lambda: all(one <= other for one, other in zip(held(), before, strict=True))
        )

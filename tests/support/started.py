"""An environment that is made, reset and in the end closed: what most tests begin with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from envhub_sandbox import make_env


@contextmanager
def started(*arguments: Any, seed: int | None = 1, **options: Any) -> Iterator[Any]:
    """The environment of what ``make_env`` makes of these arguments, after a reset."""
    with make_env(*arguments, **options) as suites:
        suites.env.reset(seed=seed)
        yield suites.env

"""The sample that dies as its actions say, and what it does where it may not."""

from collections.abc import Callable
from typing import Any

from envhub_sandbox import errors
from tests.support.samples import reference

LIVE, EXIT, KILL, CRASH, RAISE, SLOW, MEMORY, SPIN = range(8)
ALL_LIVE = [LIVE] * 4
SEED = 11


def oracle(mode: str = "NextStep") -> Any:
    """The same without a sandbox, where nobody dies."""
    return reference("mortal", n_envs=4, mode=mode)


def comes_off(act: Callable[[], object]) -> bool:
    """Whether it did: a loaded machine holds us up between two requests, and that is idleness."""
    try:
        act()
    except (errors.WorkerDiedError, StopIteration) as error:
        if isinstance(error, errors.WorkerDiedError) and error.reason != "idle":
            raise
        return False
    return True

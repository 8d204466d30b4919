"""The rows of sub-environments that came back in a fresh runner: truncated, and marked in infos."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from envhub_sandbox.transport.results import is_batch
from envhub_worker.protocol import messages as m

RESTARTED = "worker_restarted"
"""The key in the infos: whether a sub-environment was lost and came back reset."""


def revived_step(reply: m.StepDone, count: int) -> m.StepDone:
    """A fresh runner's rows of the step in which another died. Trust: its flags are not used.

    Of the rewards the shape is used where they are an array: then it was paid for in bytes. A
    described space also has a ``shape``, of any size, for a few.
    """
    rewards: Any = reply.rewards
    return m.StepDone(
        reply.observation,
        np.zeros(rewards.shape if is_batch(rewards) else (count,)),
        np.zeros(count, np.bool_),
        np.ones(count, np.bool_),
        mark_revived(reply.info, count),
    )


def mark_revived(
    info: dict[Any, Any], count: int, bounds: Iterable[tuple[int, int]] | None = None
) -> dict[Any, Any]:
    """Infos that say of each sub-environment, or of those within, that it came back."""
    yes = np.zeros(count, np.bool_)
    for start, stop in [(0, count)] if bounds is None else bounds:
        yes[start:stop] = True
    return {**info, RESTARTED: yes, f"_{RESTARTED}": yes.copy()}

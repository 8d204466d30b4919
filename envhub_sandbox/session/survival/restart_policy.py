"""How often, and how soon, an environment whose worker died gets a fresh one."""

from __future__ import annotations

import time

from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.settings.policy import Policy

_CALM_S = 60.0
_LONGEST_S = 30.0
_LOOK_AGAIN_S = 0.1


class Restarts:
    """The restarts of one environment, which its counters count."""

    def __init__(self, policy: Policy, counters: Counters) -> None:
        self._policy = policy
        self._counters = counters
        self._last = -_CALM_S
        self._in_a_row = 0
        self._given_up = False

    @property
    def permitted(self) -> bool:
        """Whether the policy permits any."""
        return self._policy.restart != "never"

    def give_up(self) -> None:
        """No more restarts are needed: a wait in another thread ends soon."""
        # interruption.md, rule 12: no Event
        self._given_up = True

    def spend(self, operation: str) -> None:
        """Count one more for an operation, and wait if the last one was a moment ago.
        Raises ``WorkerDiedError``: there are none left, or the environment was closed.
        """
        budget = self._policy.restart_budget
        if self._counters.restarts >= budget:
            raise WorkerDiedError(
                f"the worker process has died again, and all {budget} restarts are used up "
                "(restart_budget of the policy); make the environment again",
                request=operation,
            )
        calm = time.monotonic() - self._last >= _CALM_S
        self._in_a_row = 0 if calm else self._in_a_row + 1
        self._wait(backoff_s(self._policy.restart_backoff_s, self._in_a_row), operation)
        self._last = time.monotonic()
        self._counters.restarts += 1

    def _wait(self, wait_s: float, operation: str) -> None:
        until = time.monotonic() + wait_s
        while not self._given_up and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, _LOOK_AGAIN_S))
        if self._given_up:
            text = f"the environment was closed during {operation}"
            raise WorkerDiedError(text, reason="killed", request=operation)


def backoff_s(first_s: float, in_a_row: int) -> float:
    """Seconds to wait before a restart that has so many right before it."""
    if in_a_row == 0:
        return 0.0
    return min(first_s * 2.0 ** min(in_a_row - 1, 64), _LONGEST_S)

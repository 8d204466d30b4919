"""Attributes that are asked for after each step: from the second time on the runners watch them.

LeRobot's evaluation reads the task of every sub-environment after each step. That was a request,
which costs as much as the step, and on another host a way there and back. What a runner watches
(``envhub_worker.runner.watches``) is answered here, once a step: who asks twice, waits for
something to happen, and is answered by the environment.
"""

from __future__ import annotations

from typing import Any

from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.lease import Lease
from envhub_worker.protocol.lifecycle import State

_MOST = 64
"""Names of one environment that are taken note of."""
_NEVER = 1 << 62


class _Asked:
    """An attribute that has been asked for.

    Attributes:
        step: How many steps there had been when it last was answered.
        rounds: How often it was asked for after a step, since it was last watched.
        patience: How often it has to be, until it is watched.
        watched: Whether it was, when we last heard of it.
    """

    __slots__ = ("patience", "rounds", "step", "watched")

    def __init__(self, step: int) -> None:
        self.step, self.rounds, self.patience, self.watched = step, 0, 1, False


class Attributes:
    """What is known of one environment's attributes without asking. Not thread-safe.

    Args:
        lease: Its jail.
        counters: Of its steps.
    """

    def __init__(self, lease: Lease, counters: Counters) -> None:
        self._lease = lease
        self._counters = counters
        self._asked: dict[str, _Asked] = {}

    def known(self, name: str) -> tuple[Any, ...] | None:
        """What a request would be answered, if a step was answered since the last one of it."""
        asked, lane = self._asked.get(name), self._lease.lane
        if asked is None or lane is None or asked.step == self._counters.steps:
            return None
        if self._lease.lifecycle.state is not State.READY:
            return None
        values = lane.jail.watched.values(lane.number, name)
        if values is not None:
            asked.step = self._counters.steps
        return values

    def wanted(self, name: str) -> bool:
        """It is going to be asked for: whether it is to be watched from now on."""
        lane, steps = self._lease.lane, self._counters.steps
        if lane is None:
            return False
        asked = self._asked.get(name)
        if asked is None:
            if len(self._asked) < _MOST:
                self._asked[name] = _Asked(steps)
            return False
        if asked.watched and lane.jail.watched.values(lane.number, name) is None:
            # it changes: with each time that it does, it takes twice as long to be trusted again
            asked.watched, asked.rounds, asked.patience = False, 0, 2 * asked.patience
        asked.rounds += asked.step != steps
        asked.step = steps
        return asked.rounds >= asked.patience

    def learn(self, name: str, values: tuple[Any, ...], *, watched: bool) -> None:
        """What was answered to the request for which it was ``wanted``."""
        lane, asked = self._lease.lane, self._asked[name]
        asked.watched = (
            watched and lane is not None and lane.jail.watched.note(lane.number, name, values)
        )
        if not asked.watched:
            asked.patience = _NEVER

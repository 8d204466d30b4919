"""Attributes that are read after each step: from the second time on the runners watch them.

LeRobot's evaluation reads the task of every sub-environment after each step. Each read was a
request, which costs as much as the step, and on another host a round trip. A watched attribute
(``envhub_worker.runner.prefixes``) is answered from here, once a step: a caller that reads it twice
waits for something to happen, and the environment answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_sandbox.session.lease import Lease
from envhub_worker.protocol.lifecycle import State

_MOST = 64
"""Names of one environment that are remembered."""
_NEVER = 1 << 62


class _Reads:
    """The reads of one attribute.

    Attributes:
        step: How many steps there had been at the last one.
        rounds: How many came after a step, since it was last watched.
        patience: How many are needed until it is watched.
        watched: Whether it was, at the last answer.
    """

    __slots__ = ("patience", "rounds", "step", "watched")

    def __init__(self, step: int) -> None:
        self.step, self.rounds, self.patience, self.watched = step, 0, 1, False


class AttributeCache:
    """The attributes of one environment that need no request. Not thread-safe."""

    def __init__(self, lease: Lease) -> None:
        self._lease = lease
        self._counters = lease.counters
        self._reads: dict[str, _Reads] = {}

    def get(self, name: str) -> tuple[Any, ...] | None:
        """The values, if a step was answered since the last read; None: a request is needed."""
        reads, lane = self._reads.get(name), self._lease.lane
        if reads is None or lane is None or reads.step == self._counters.steps:
            return None
        if self._lease.lifecycle.state is not State.READY:
            return None
        values = lane.jail.watched.values(lane.number, name)
        if values is not None:
            reads.step = self._counters.steps
        return values

    def should_watch(self, name: str) -> bool:
        """A request for it follows: whether that request is to have it watched."""
        lane, steps = self._lease.lane, self._counters.steps
        if lane is None:
            return False
        reads = self._reads.get(name)
        if reads is None:
            if len(self._reads) < _MOST:
                self._reads[name] = _Reads(steps)
            return False
        if reads.watched and lane.jail.watched.values(lane.number, name) is None:
            # it has changed: with each time that it does, it takes twice as long to be watched
            reads.watched, reads.rounds, reads.patience = False, 0, 2 * reads.patience
        reads.rounds += reads.step != steps
        reads.step = steps
        return reads.rounds >= reads.patience

    def put(self, name: str, values: tuple[Any, ...], *, watched: bool) -> None:
        """Keep the answer to a request after ``should_watch``; ``watched`` is the runners' word."""
        lane, reads = self._lease.lane, self._reads[name]
        reads.watched = (
            watched and lane is not None and lane.jail.watched.note(lane.number, name, values)
        )
        if not reads.watched:
            reads.patience = _NEVER


class FleetAttributes:
    """Those of an environment over several workers: see ``AttributeCache``."""

    def __init__(self, parts: Sequence[AttributeCache], bounds: Sequence[tuple[int, int]]) -> None:
        self._parts = parts
        self._bounds = bounds

    def get(self, name: str) -> tuple[Any, ...] | None:
        """The values, if all parts know theirs."""
        found: list[Any] = []
        for one in self._parts:
            values = one.get(name)
            if values is None:
                return None
            found += values
        return tuple(found)

    def should_watch(self, name: str) -> bool:
        """Whether every part is to be asked to watch it."""
        wanted = [one.should_watch(name) for one in self._parts]  # each takes note of it
        return all(wanted)

    def put(self, name: str, values: tuple[Any, ...], *, watched: bool) -> None:
        """Keep the answers of all parts."""
        for one, (start, stop) in zip(self._parts, self._bounds, strict=True):
            one.put(name, values[start:stop], watched=watched)

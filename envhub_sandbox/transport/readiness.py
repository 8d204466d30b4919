"""Waiting for the first of several lanes, whichever way each of them goes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import zmq

from envhub_sandbox.transport.connection import Source
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import RECHECK_MS, Lane

LOOK_MS = 500
"""One wait: lanes over a network have to be asked in between whether they are still there."""


def answered_first(lanes: Sequence[Lane], deadline: Deadline) -> list[int]:
    """The places of those that have answered, or ended; none where the deadline came first.

    Sleeps until there is one. A lane that always claims to have answered, or rings without end,
    keeps no other from being found.
    """
    everywhere = range(len(lanes))
    found = _answered(lanes, everywhere)
    if found or deadline.passed:
        return found
    poller, places = zmq.Poller(), _listen(lanes)
    for source in places:
        poller.register(source, zmq.POLLIN)
    look = Deadline(RECHECK_MS / 1000)  # an answer may have crossed with our beginning to listen
    while not found and not deadline.passed:
        left_ms, look_ms = deadline.left_ms(), look.left_ms() or 0
        rung = poller.poll(look_ms if left_ms is None else min(look_ms, left_ms))
        some: Iterable[int] = sorted({place for source, _ in rung for place in places[source]})
        if look.passed:  # also where one rings without end
            some, look = everywhere, Deadline(LOOK_MS / 1000)
        found = _answered(lanes, some)
    return found


def _listen(lanes: Sequence[Lane]) -> dict[Source, list[int]]:
    """What is to be polled, and for which lanes: those in one server share some of it."""
    places: dict[Source, list[int]] = {}
    for place, lane in enumerate(lanes):
        for source in lane.sources():
            places.setdefault(source, []).append(place)
    return places


def _answered(lanes: Sequence[Lane], places: Iterable[int]) -> list[int]:
    return [place for place in places if lanes[place].answered()]

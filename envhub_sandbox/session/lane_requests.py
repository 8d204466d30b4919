"""Requests that go straight to the runners, by the fast lane, and what comes back with a step.

Functions over a place; whoever calls them knows what state the environment is in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from envhub_sandbox.session.placement import Place
from envhub_sandbox.session.results import Results
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.shared_memory.lane import Outcome
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.manifest import EnvManifest
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.stream import pack_packet
from envhub_worker.protocol.untrusted import UNTRUSTED

_BULKY = frozenset({"render"})
"""What hardly ever fits the lane."""
_FRAME_BYTES = 8
_ROOM = slabs.INFO_BYTES - 64
"""For the frames of a message, less what is put around them."""


def takes(operation: str, messages: Sequence[Sequence[Buffer]]) -> bool:
    """Whether the lane takes such a request. A step's own messages are for the server."""
    if operation == "step" or operation in _BULKY:
        return False
    return all(_size(frames) < _ROOM for frames in messages)


def _size(frames: Sequence[Buffer]) -> int:
    return sum(memoryview(frame).nbytes + _FRAME_BYTES for frame in frames)


def tell(place: Place, operation: str, messages: Sequence[Sequence[Buffer]]) -> None:
    """Send each shard's runner its message."""
    assert place.lane is not None
    packets = [b"".join(pack_packet(0, frames)) for frames in messages]
    place.lane.tell(packets, moves=operation == "reset")


def answers(place: Place, operation: str, deadline: Deadline) -> list[m.Message]:
    """What the runners answer; what did not fit the lane is fetched.

    Raises:
        WorkerTimeoutError: The deadline came first.
        JailGoneError: The jail has ended.
        RemoteProtocolError: A runner broke the rules.
    """
    lane, jail = place.lane, place.loaded.jail
    assert lane is not None
    lane.wait_for_all(deadline)
    replies: list[m.Message] = []
    for runner, answer in zip(place.runners, lane.answers(), strict=True):
        if answer is None:
            asked = [(runner, m.FetchInfos(place.number))]
            [answer] = jail.receive(jail.send(operation, asked), deadline)
        replies.append(answer)
    return replies


def with_observations(
    place: Place,
    replies: Sequence[m.Message],
    manifest: EnvManifest,
    bounds: Sequence[tuple[int, int]],
    results: Results,
) -> list[m.Message]:
    """Replies to a reset as they would have come through the server."""
    assert place.lane is not None
    with UNTRUSTED:
        batch = place.lane.observation()
        parts = batches.split(manifest.single_observation_space, batch, bounds)
        return [
            reply if isinstance(reply, m.Raised) else results.reset_done(part, reply)
            for part, reply in zip(parts, replies, strict=True)
        ]


def infos(
    place: Place,
    outcomes: Sequence[Outcome],
    results: Results,
    fetch: Callable[[int], m.Message],
) -> list[dict[Any, Any]]:
    """A step's infos, shard by shard; ``fetch`` asks the runner whose infos did not fit.

    Raises:
        RemoteEnvError: The environment raised.
    """
    assert place.lane is not None
    shards = zip(outcomes, place.lane.shards, place.runners, strict=True)
    return [
        results.lane_info(outcome, shard, partial(fetch, runner))
        for outcome, shard, runner in shards
    ]

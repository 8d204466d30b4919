"""A request as it goes out: made and encoded once, for whoever sends it or has to know it later."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer

Frames = list[Buffer]


class Request:
    """What each shard is sent.

    Args:
        operation: What the user called.
        messages: One for each shard.
        frames: Those of each message.
        bounds: The slices of the sub-environments, one for each shard.
        plain: Whether there is nothing in them that only pickle could carry.
    """

    __slots__ = ("_kept", "bounds", "frames", "messages", "operation", "plain")

    def __init__(
        self,
        operation: str,
        messages: Sequence[m.Message],
        frames: Sequence[Frames],
        bounds: list[tuple[int, int]],
        *,
        plain: bool,
    ) -> None:
        self.operation = operation
        self.messages = messages
        self.frames = frames
        self.bounds = bounds
        self.plain = plain
        self._kept: list[list[bytes]] | None = None

    def kept(self) -> list[list[bytes]]:
        """The frames, copied: large values are sent from where they lie, and may change."""
        if self._kept is None:
            self._kept = [list(map(bytes, frames)) for frames in self.frames]
        return self._kept


def whole(messages: Sequence[m.Message], bounds: Sequence[tuple[int, int]]) -> m.Message:
    """One message of those for all shards, to no environment in particular."""
    first: Any = messages[0]
    changes: dict[str, Any] = {"env": 0}
    others: Sequence[Any] = messages
    if isinstance(first, m.Reset):
        if isinstance(first.seeds, list):
            changes["seeds"] = [seed for one in others for seed in one.seeds]
        if first.mask is not None:
            changes["mask"] = np.concatenate([one.mask for one in others])
    if isinstance(first, m.SetAttr):
        changes["values"] = tuple(value for one in others for value in one.values)
    if isinstance(first, (m.GetOne, m.CallOne)):
        places = [
            start + one.index
            for (start, _), one in zip(bounds, others, strict=True)
            if one.index is not None
        ]
        changes["index"] = places[0] if places else None
    made: m.Message = m.replace(first, **changes)
    return made

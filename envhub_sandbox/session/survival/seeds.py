"""Seeds and attributes for the fresh runner of a dead shard, with ``restart="transparent"``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from envhub_worker.protocol import messages as m

Bounds = tuple[int, int]
Seeds = list[int | None]
Frames = list[bytes]
_SETTINGS = 256
"""Attributes that are remembered, the last ones."""


class SeedBook:
    """What sub-environments were last seeded with, and what those that come back get.

    Where the caller gave a seed, what follows a death is derived of it, so that the same run can be
    had again; where he gave none, the fresh one is drawn by the environment.
    ``each``: whether they are seeded one by one; otherwise the environment does that by itself.
    """

    def __init__(self, num_envs: int, each: bool) -> None:
        self._each = each
        self._last: Seeds = [None] * num_envs
        self._own: Any = None

    def remember(self, reset: m.Reset, start: int = 0) -> None:
        """Take note of a reset of sub-environments from ``start`` on, or of those in its mask."""
        seeds: Any = reset.seeds
        if seeds is None:
            return
        if not self._each:
            self._own = seeds
            return
        chosen_of: Any = [True] * len(seeds) if reset.mask is None else reset.mask
        for index, (chosen, seed) in enumerate(zip(chosen_of, seeds, strict=True), start):
            if chosen and seed is not None:
                self._last[index] = seed

    def derived(self, bounds: Bounds, restart: int) -> Any:
        """Seeds for the sub-environments of a shard that comes back."""
        if self._each:
            return [derived_seed(seed, restart) for seed in self._last[slice(*bounds)]]
        if isinstance(self._own, list):
            return [derived_seed(seed, restart) for seed in self._own]
        return derived_seed(self._own, restart)


class Settings:
    """Attributes that the caller has set: the last message of each, as the shards were sent it."""

    def __init__(self) -> None:
        self._sent: dict[str, Sequence[Frames]] = {}

    def remember(self, name: str, sent: Sequence[Frames]) -> None:
        """Take note of what was set, given the frames for each shard."""
        self._sent.pop(name, None)  # the last one counts, in its place
        self._sent[name] = sent
        if len(self._sent) > _SETTINGS:
            del self._sent[next(iter(self._sent))]

    def clear(self) -> None:
        """There is a fresh jail, in which nothing has been set."""
        self._sent.clear()

    def messages(self) -> list[tuple[str, Sequence[Frames]]]:
        """Names, and the frames for each shard."""
        return list(self._sent.items())


def derived_seed(seed: int | None, restart: int) -> int | None:
    """The seed after the ``restart``-th restart of what was last seeded with ``seed``."""
    if seed is None:
        return None
    return int(np.random.SeedSequence((abs(seed), restart)).generate_state(1)[0])


def resets(message: m.Reset, derived: Any) -> list[m.Message]:
    """What a fresh runner is asked in the place of one that died in a reset.

    The reset itself, with derived seeds where the caller gave none; where it is one of some
    sub-environments only, all are reset before.
    """
    if message.mask is not None:
        return [m.Reset(message.env, derived, None, None), message]
    return [m.replace(message, seeds=_filled(message.seeds, derived))]


def _filled(seeds: Any, derived: Any) -> Any:
    if not isinstance(seeds, list) or not isinstance(derived, list):
        return derived if seeds is None else seeds
    return [new if seed is None else seed for seed, new in zip(seeds, derived, strict=True)]

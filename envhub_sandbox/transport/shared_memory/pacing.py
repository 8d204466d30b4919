"""What the steps of one environment take, measured now and then: for ``sharding`` the next time."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from envhub_sandbox.transport.pace import Cost, Pace
from envhub_sandbox.transport.shared_memory.shard import LaneShard
from envhub_sandbox.transport.shared_memory.sharding import ASK_NS, Sample, pace_of

_PACE_STEPS = 256
"""Steps after which what shards cost one another is worth remembering."""
_LEAST_SHARE = 0.25
"""How much a step counts at least where a life was shorter."""
_SAMPLES = 64


class Pacing:
    """Samples of steps over several shards.

    Args:
        sizes: Sub-environments of each shard.
        awake: How many shards, the first ones, may wait awake.
    """

    def __init__(self, sizes: Sequence[int], awake: int) -> None:
        self._sizes = list(sizes)
        self._awake = awake
        self._samples: deque[Sample] = deque(maxlen=_SAMPLES)

    def sample(self, shards: Sequence[LaneShard], slept_ns: int, elapsed_ns: int) -> None:
        """Take note of the last step, which every shard has measured."""
        busy = [shard.busy_ns for shard in shards]
        asleep, awake = busy[self._awake :], busy[: self._awake]
        if asleep and awake and all(busy):
            self._samples.append(Sample(slept_ns, elapsed_ns, max(asleep), max(awake)))

    def pace(self, shards: Sequence[LaneShard]) -> Pace | None:
        """What the steps took; None where none was measured.

        An evaluation plays each task of a suite for a few steps. After so few, what a wake-up costs
        is not told from one or two of them, but how long a step is can be: the shard that was
        disturbed least says so. It counts as shorter than it was: so short a life does not make up
        for the start of a process more, and one step may have been disturbed in every shard.
        """
        if self._samples and shards[0].sequence >= _PACE_STEPS:
            asleep, awake = self._sizes[self._awake :], self._sizes[: self._awake]
            return pace_of(self._samples, max(asleep), max(awake))
        each = [shard.busy_ns / size for shard, size in zip(shards, self._sizes, strict=True)]
        share = min(1.0, max(_LEAST_SHARE, shards[0].sequence / _PACE_STEPS))
        return Pace(Cost(ASK_NS, share * min(each)), None) if all(each) else None

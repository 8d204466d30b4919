"""How long to wait: one deadline per operation, and whether to wait awake for a reply.

A deadline is made once and passed down, and asked for what is left at each wait.

A wake-up costs some ten microseconds, so a reply that is nearly there is best waited for awake.
With every core busy the same spinning takes the core from the runner that computes the reply. So
both ways are tried in turn, seldom, and the faster one is used; the interval between trials doubles
while the answer stays the same. One decision serves both sides: the client's wait for the reply
and the runner's wait for the next request.

One core is the client's. The shards that get cores of their own may wait for work awake; one that
finds none sleeps until it is asked, and runs on the client's core while the client sleeps. Left
alone, the kernel tends to wake shards on the core of the process that woke them, and they run one
after the other. So each keeps to a core.
"""

from __future__ import annotations

import ctypes
import os
from time import monotonic

_LONGEST_WAIT_MS = 24 * 3600 * 1000
"""One wait; who waits asks again afterwards. Infinity has no milliseconds."""

_LOOK_AGAIN_MS = 100


class Deadline:
    """A point in time. ``Deadline(None)`` never comes.

    Attributes:
        timeout_s: How far away it was.
    """

    __slots__ = ("_at", "timeout_s")

    unasked = False
    """Whether it is for work in advance, which no request waits for."""

    def __init__(self, timeout_s: float | None) -> None:
        self.timeout_s = timeout_s
        self._at = None if timeout_s is None else monotonic() + timeout_s

    def left_s(self) -> float | None:
        """Seconds until it comes, at least 0; None for never."""
        return None if self._at is None else max(0.0, self._at - monotonic())

    def left_ms(self) -> int | None:
        """Milliseconds until it comes, rounded up, or a day; None for never."""
        left = self.left_s()
        return None if left is None else int(min(left * 1000 + 1, _LONGEST_WAIT_MS))

    def postpone(self, seconds: float) -> None:
        """Extend the deadline by ``seconds``."""
        if self._at:  # 0 has been given up
            self._at += seconds

    @property
    def passed(self) -> bool:
        """Whether it has come."""
        return self._at is not None and monotonic() >= self._at


class PartDeadline(Deadline):
    """So much of what is left of another deadline, which also ends it."""

    __slots__ = ("_whole",)

    def __init__(self, whole: Deadline, share: float) -> None:
        left_s = whole.left_s()
        super().__init__(None if left_s is None else left_s * share)
        self._whole = whole

    def left_ms(self) -> int | None:
        """As the other: its waits may be short."""
        left = (super().left_ms(), self._whole.left_ms())
        return min((seconds for seconds in left if seconds is not None), default=None)

    @property
    def passed(self) -> bool:
        """Whether one of them has come."""
        return super().passed or self._whole.passed


def deadline_of(timeout: float | Deadline | None) -> Deadline:
    """A deadline so many seconds from now; one that several waits share is given as it is."""
    return timeout if isinstance(timeout, Deadline) else Deadline(timeout)


class StepDeadline(Deadline):
    """A deadline that serves every step, and counts from its first wait.

    Most replies are there before a wait has to sleep, and to make a deadline and read the clock
    for it costs more than one per cent of a short step. How long a lane waits awake before it asks
    (a fraction of a millisecond) does not count.

    Attributes:
        running: Whether it counts already; False when the next step begins.
    """

    __slots__ = ("running",)

    def __init__(self, timeout_s: float | None) -> None:
        super().__init__(timeout_s)
        self.running = False

    def left_s(self) -> float | None:
        """As ``Deadline``; the first time it starts to count."""
        self._run()
        return super().left_s()

    @property
    def passed(self) -> bool:
        """As ``Deadline``; the first time it starts to count."""
        self._run()
        return super().passed

    def _run(self) -> None:
        if not self.running:
            self.running = True
            self._at = None if self.timeout_s is None else monotonic() + self.timeout_s


class StartupDeadline(Deadline):
    """A deadline that another thread can bring forward: its waits are short."""

    __slots__ = ("unasked",)

    def __init__(self, timeout_s: float | None, *, unasked: bool = False) -> None:
        super().__init__(timeout_s)
        self.unasked = unasked

    def give_up(self) -> None:
        """It has come."""
        self.unasked = True
        self._at = 0.0

    def left_ms(self) -> int:
        """Milliseconds until the next look; at most ``_LOOK_AGAIN_MS``."""
        left = super().left_ms()
        return _LOOK_AGAIN_MS if left is None else min(left, _LOOK_AGAIN_MS)


# --- waiting awake -------------------------------------------------------------------------------

_TRIAL = 16
"""Steps of one trial."""
_FIRST_INTERVAL = 64
_LONGEST_INTERVAL = 8192
_MAX_BUDGET_NS = 400_000
"""A reply that is further away than this is not worth waiting awake for."""
_MIN_BUDGET_NS = 100_000
_MISSES = 3
"""Waits in vain, one after the other, that end spinning at once."""
_ADVANTAGE = 0.97
"""Spinning must be this much faster to be chosen: it burns a core."""


class SpinChooser:
    """The chooser. ``measured`` is called once a step.

    Attributes:
        budget_ns: How long each side may wait awake; 0 for not at all.
    """

    def __init__(self, allowed: bool) -> None:
        self.budget_ns = 0
        self._chosen = self._spinning = False
        self._best = {False: 0, True: 0}
        self._samples: list[int] = []
        self._misses = 0
        self._missed_at: float = 0
        self._trials = 2 if allowed else 0
        self._interval = _FIRST_INTERVAL
        # steps until the next decision: none ever comes where spinning is not allowed
        self._left: float = _TRIAL if allowed else float("inf")

    def measured(self, elapsed_ns: int) -> None:
        """Take note of how long a step took, and decide when it is time to."""
        self._left -= 1
        if self._trials:
            self._samples.append(elapsed_ns)
        if self._left > 0:
            return
        if self._samples:  # the median: one hiccup of the machine must not decide
            self._best[self._spinning] = sorted(self._samples)[len(self._samples) // 2]
            self._samples.clear()
        self._decide()

    def missed(self) -> None:
        """A wait used its whole budget up: another process has the core. A few in a row end it."""
        self._misses = self._misses + 1 if self._missed_at - self._left <= 1 else 1
        self._missed_at = self._left
        if self._misses >= _MISSES and self._spinning:
            self._samples.clear()
            self._trials = 0
            self._chosen = False
            self._interval = _FIRST_INTERVAL
            self._use(False, _FIRST_INTERVAL)

    def _decide(self) -> None:
        if self._trials:
            self._trials -= 1
            if self._trials:
                self._use(not self._spinning, _TRIAL)
                return
            better = self._best[True] < self._best[False] * _ADVANTAGE
            same, self._chosen = better == self._chosen, better
            self._interval = min(self._interval * 2, _LONGEST_INTERVAL) if same else _FIRST_INTERVAL
            self._use(better, self._interval)
            return
        self._trials = 2
        self._use(self._spinning, _TRIAL)

    def _use(self, spinning: bool, steps: int) -> None:
        self._spinning = spinning
        self._left = steps
        self._misses = 0
        # a reply that takes much longer than awake ones usually do will not come soon
        usual = 3 * self._best[True] or _MAX_BUDGET_NS
        self.budget_ns = min(max(usual, _MIN_BUDGET_NS), _MAX_BUDGET_NS) if spinning else 0


_LOOK_EVERY = 64
"""Steps between two looks at where the client runs."""


def own_cpus() -> list[int]:
    """The cores that this process may use now: it may keep to fewer of them after its imports."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]


class Cores:
    """The cores of one environment's shards.
    ``shards``: how many there are.

    Attributes:
        awake: How many of them, the first ones, get a core that is not the client's.
    """

    def __init__(self, shards: int) -> None:
        self._cpus = own_cpus()
        self.awake = min(shards, len(self._cpus) - 1)
        self._until_look = 0
        self._client = -1
        self._chosen = [0] * shards
        self._getcpu = getattr(ctypes.CDLL(None), "sched_getcpu", None)

    def of_shards(self) -> list[int]:
        """One more than each shard's core; 0 where it does not matter."""
        self._until_look -= 1
        if self._until_look < 0:
            self._until_look = _LOOK_EVERY
            client = self._getcpu() if self._getcpu is not None else -1
            if client != self._client and client in self._cpus:
                self._client = client
                self._chosen = place(len(self._chosen), self.awake, client, self._cpus)
        return self._chosen


def place(shards: int, awake: int, client: int, cpus: list[int]) -> list[int]:
    """One more than each shard's core, the awake ones first."""
    others = [cpu for cpu in cpus if cpu != client]
    sleepers = [client, *others]
    return [
        1 + (others[index] if index < awake else sleepers[(index - awake) % len(sleepers)])
        for index in range(shards)
    ]

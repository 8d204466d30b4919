"""How long to wait: one deadline per operation, and whether to wait awake for a reply.

An operation makes its deadline once and passes it down; each wait asks it for the time left.

To wait awake is to spin on the slab. A wake-up from sleep costs some ten microseconds, so spinning
is faster if the reply comes soon. If every core is busy, spinning takes the core from the runner
that computes the reply. So ``SpinChooser`` seldom tries both ways in turn and uses the faster one;
the interval between trials doubles while the result stays the same. One decision serves both
sides: the client's wait for the reply and the runner's wait for the next request.

One core is the client's. A shard with a core of its own may wait awake for work. A shard without
one sleeps until a request comes, and runs on the client's core while the client sleeps. By itself
the kernel tends to wake shards on the core of the process that woke them, so that they run one
after the other. So ``Cores`` assigns each shard to a core. A single shard that sleeps is best
there; one that the client waits awake for would never run there, so it avoids the client's core.
"""

from __future__ import annotations

import ctypes
from time import monotonic

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_sandbox.system.platform import own_cpus
from envhub_worker.protocol.shared_memory.words import AVOIDED

_LONGEST_WAIT_MS = 24 * 3600 * 1000
"""The longest single wait; after it the caller waits again. Infinity has no milliseconds."""

_LOOK_AGAIN_MS = 100


class Deadline:
    """A point in time. ``Deadline(None)`` never comes.
    ``timeout_s``: the seconds from its creation until it comes.
    """

    __slots__ = ("_at", "timeout_s")

    unasked = False
    """Whether the work is done in advance, and no request waits for it."""

    def __init__(self, timeout_s: float | None) -> None:
        self.timeout_s = timeout_s
        self._at = None if timeout_s is None else monotonic() + timeout_s

    def left_s(self) -> float | None:
        """Seconds until it comes, at least 0; None for never."""
        return None if self._at is None else max(0.0, self._at - monotonic())

    def left_ms(self) -> int | None:
        """Milliseconds until it comes, rounded up, at most a day; None for never."""
        left = self.left_s()
        return None if left is None else int(min(left * 1000 + 1, _LONGEST_WAIT_MS))

    def postpone(self, seconds: float) -> None:
        """Extend the deadline by ``seconds``."""
        if self._at:  # 0 means that ``give_up`` was called
            self._at += seconds

    @property
    def passed(self) -> bool:
        """Whether it has come."""
        return self._at is not None and monotonic() >= self._at

    def check(self, text: str = "the worker did not answer in time") -> None:
        """Raise ``WorkerTimeoutError`` if it has come."""
        if self.passed:
            raise WorkerTimeoutError(text)


class PartDeadline(Deadline):
    """A share of the time left of another deadline; it also ends when that deadline passes."""

    __slots__ = ("_whole",)

    def __init__(self, whole: Deadline, share: float) -> None:
        left_s = whole.left_s()
        super().__init__(None if left_s is None else left_s * share)
        self._whole = whole

    def left_ms(self) -> int | None:
        """Milliseconds until the earlier of both deadlines; None for never."""
        left = (super().left_ms(), self._whole.left_ms())
        return min((seconds for seconds in left if seconds is not None), default=None)

    @property
    def passed(self) -> bool:
        """Whether one of both deadlines has come."""
        return super().passed or self._whole.passed


def deadline_of(timeout: float | Deadline | None) -> Deadline:
    """A deadline ``timeout`` seconds from now; a ``Deadline`` is returned unchanged."""
    return timeout if isinstance(timeout, Deadline) else Deadline(timeout)


class StepDeadline(Deadline):
    """A deadline that is reused for every step, and counts from the step's first wait.

    Most replies are there before a wait has to sleep, and a new deadline with a reading of the
    clock costs more than one per cent of a short step. The time that a lane waits awake before
    (a fraction of a millisecond) does not count.
    ``running``: whether it counts already; the caller sets it to False for each step.
    """

    __slots__ = ("_whole_ms", "running")

    def __init__(self, timeout_s: float | None) -> None:
        super().__init__(timeout_s)
        self.running = True
        self._whole_ms = self.left_ms()
        self.running = False

    def left_ms(self) -> int | None:
        """As in ``Deadline``; the first call of a step, which starts the clock, needs no other."""
        if self.running:
            return super().left_ms()
        self._run()
        return self._whole_ms

    def left_s(self) -> float | None:
        """As in ``Deadline``; the first call of a step starts the clock."""
        self._run()
        return super().left_s()

    @property
    def passed(self) -> bool:
        """As in ``Deadline``; the first call of a step starts the clock."""
        self._run()
        return super().passed

    def _run(self) -> None:
        if not self.running:
            self.running = True
            self._at = None if self.timeout_s is None else monotonic() + self.timeout_s


class StartupDeadline(Deadline):
    """A deadline that another thread can end early, so each single wait is short."""

    __slots__ = ("unasked",)

    def __init__(self, timeout_s: float | None, *, unasked: bool = False) -> None:
        super().__init__(timeout_s)
        self.unasked = unasked

    def give_up(self) -> None:
        """End the deadline now: nobody asks for the work any more."""
        self.unasked = True
        self._at = 0.0

    def left_ms(self) -> int:
        """Milliseconds until it comes, at most ``_LOOK_AGAIN_MS``."""
        left = super().left_ms()
        return _LOOK_AGAIN_MS if left is None else min(left, _LOOK_AGAIN_MS)


# --- waiting awake -------------------------------------------------------------------------------

_TRIAL = 16
"""Steps of one trial."""
_FIRST_INTERVAL = 64
_LONGEST_INTERVAL = 8192
_MAX_BUDGET_NS = 1_500_000
"""The longest wait awake; for later replies sleep costs little in comparison."""
_MIN_BUDGET_NS = 100_000
_MISSES = 3
"""After so many misses in a row spinning ends at once."""
_ADVANTAGE = 0.97
"""Spinning must be this much faster to be chosen: it burns a core."""


class SpinChooser:
    """Chooses between spinning and sleep. The lane calls ``measured`` once for each step.
    ``longest_ns``: the longest wait awake that it may choose.
    ``budget_ns``: how long each side may wait awake, the runner up to ``MAX_SPIN_NS`` of it; 0 for
    not at all.
    """

    def __init__(self, allowed: bool, longest_ns: int = _MAX_BUDGET_NS) -> None:
        self.budget_ns, self._longest_ns = 0, longest_ns
        self._chosen = self._spinning = False
        self._best = {False: 0, True: 0}  # the median time of a step, asleep and awake
        self._samples: list[int] = []  # of the running trial
        self._misses = 0  # waits in a row that used up their budget
        self._missed_at: float = 0
        self._trials = 2 if allowed else 0
        self._interval = _FIRST_INTERVAL  # steps between two trials
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

    def missed(self) -> None:
        """Note a wait that used up its whole budget; ``_MISSES`` in a row end spinning."""
        self._misses = self._misses + 1 if self._missed_at - self._left <= 1 else 1
        self._missed_at = self._left
        if self._misses >= _MISSES and self._spinning:
            self._samples.clear()
            self._trials = 0
            self._chosen = False
            self._interval = _FIRST_INTERVAL
            self._use(False, _FIRST_INTERVAL)

    def _use(self, spinning: bool, steps: int) -> None:
        self._spinning = spinning
        self._left = steps
        self._misses = 0
        # a reply that takes much longer than awake ones usually do will not come soon
        usual = 3 * self._best[True] or self._longest_ns
        self.budget_ns = min(max(usual, _MIN_BUDGET_NS), self._longest_ns) if spinning else 0


_ANY = [0]
_LOOK_EVERY = 64
"""Steps between two looks at where the client runs."""


class Cores:
    """Assigns cores to the shards of one environment.
    ``shards``: the number of shards.
    ``awake``: the number of shards, counted from the first, with a core that is not the client's.
    """

    def __init__(self, shards: int) -> None:
        self._cpus = own_cpus()
        self.awake = min(shards, len(self._cpus) - 1)
        self._until_look = 0  # steps until the next look at where the client runs
        self._client = -1  # the client's core at the last look
        self._chosen = [0] * shards
        self._getcpu = getattr(ctypes.CDLL(None), "sched_getcpu", None)

    def of_shards(self, awake: bool) -> list[int]:
        """For each shard its word ``CPU``; ``awake``: whether the client waits awake for it."""
        if len(self._chosen) == 1 and not awake:
            return _ANY
        self._until_look -= 1
        if self._until_look < 0:
            self._until_look = _LOOK_EVERY
            client = self._getcpu() if self._getcpu is not None else -1
            if client != self._client and client in self._cpus:
                self._client = client
                self._chosen = place(len(self._chosen), self.awake, client, self._cpus)
        return self._chosen

    def look_again(self) -> None:
        """Look at once where the client runs: it may have moved to the core of a shard."""
        self._until_look = 0


def place(shards: int, awake: int, client: int, cpus: list[int]) -> list[int]:
    """For each shard its word ``CPU``; the first ``awake`` shards get cores of their own."""
    if shards == 1:  # not a certain core: single shards of many clients would share that
        return [AVOIDED + 1 + client]
    others = [cpu for cpu in cpus if cpu != client]
    sleepers = [client, *others]
    return [
        1 + (others[index] if index < awake else sleepers[(index - awake) % len(sleepers)])
        for index in range(shards)
    ]

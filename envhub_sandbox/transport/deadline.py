"""One deadline per operation, made once and passed down, asked for what is left at each wait."""

from __future__ import annotations

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
        """So much of the time does not count."""
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
        return min((one for one in left if one is not None), default=None)

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

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
    """Whether it is for something that nobody has asked for yet, or not any more."""

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

    @property
    def passed(self) -> bool:
        """Whether it has come."""
        return self._at is not None and monotonic() >= self._at


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
        """Milliseconds until somebody should look again."""
        left = super().left_ms()
        return _LOOK_AGAIN_MS if left is None else min(left, _LOOK_AGAIN_MS)

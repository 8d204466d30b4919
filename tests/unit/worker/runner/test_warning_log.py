"""What the runner hears of warnings: each text once, bounded, fit to be printed."""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Iterator

import gymnasium as gym
import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.prefix import WARNINGS
from envhub_worker.runner.warning_log import WarningLog

REPLY = m.pack(m.Value(1))


@pytest.fixture
def heard() -> Iterator[WarningLog]:
    """Somebody who listens; afterwards nobody does."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        one = WarningLog()
        with pytest.MonkeyPatch.context() as patch:  # and shows nothing
            patch.setattr(warnings, "showwarning", lambda *_: None)
            one.listen()
            yield one


def test_each_text_is_heard_once(heard: WarningLog) -> None:
    """From any thread, and of each category."""
    for _ in range(3):
        warnings.warn("slow", stacklevel=1)
    other = threading.Thread(target=warnings.warn, args=("slow", RuntimeWarning))
    other.start()
    other.join()
    assert heard.pending == [("UserWarning", "slow"), ("RuntimeWarning", "slow")]


def test_gymnasiums_logger_is_heard_without_its_colors(heard: WarningLog) -> None:
    """It says what it says by a warning."""
    gym.logger.warn("too %s", "slow")
    assert heard.pending == [("UserWarning", "WARN: too slow")]


def test_what_is_shown_is_shown_still() -> None:
    """It stands in what the jail prints; what goes to a file of its own is nobody else's."""
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        shown: list[str] = []
        patch.setattr(warnings, "showwarning", lambda message, *_: shown.append(str(message)))
        heard = WarningLog()
        heard.listen()
        warnings.showwarning("printed", UserWarning, "env.py", 1)
        warnings.showwarning("elsewhere", UserWarning, "env.py", 1, io.StringIO())
    assert shown == ["printed", "elsewhere"]
    assert heard.pending == [("UserWarning", "printed")]


def test_what_has_no_text_is_not_heard(heard: WarningLog) -> None:
    """Its class is the repository's own."""

    class Mute(UserWarning):
        def __str__(self) -> str:
            raise ValueError("no")

    warnings.showwarning(Mute(), Mute, "env.py", 1)
    assert heard.pending == []


def test_a_flood_is_bounded(heard: WarningLog) -> None:
    """In number and in length, for each reply and for all of them."""
    for number in range(2000):
        warnings.showwarning(f"{number} " + "\x1b" * 5000, UserWarning, "env.py", 1)
    told = []
    while heard.pending:
        frames = heard.in_front(REPLY)
        assert frames[1:] == REPLY
        told.append(WARNINGS.read(frames)[0])
    assert {len(some) for some in told} == {WARNINGS.most}
    assert len(told) < 100
    assert all(text.isprintable() or "\n" in text for some in told for _, text in some)
    assert heard.in_front(REPLY) == REPLY

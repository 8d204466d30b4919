"""What is started ahead is a favour: a request for something else does not fail for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, cast

import pytest

from envhub_sandbox.session.prewarm import Prewarm, SuitePrewarm
from envhub_worker.protocol.lifecycle import Lifecycle


class _Task:
    """One environment of a suite, as far as this concerns it."""

    lifecycle = Lifecycle()
    closed = False

    def __init__(self) -> None:
        self.warm, self.cancelled = threading.Event(), threading.Event()
        self.used: Callable[[], None] = self.warm.set

    def on_first_use(self, used: Callable[[], None], make_room: Callable[[], bool]) -> None:
        self.used, self.make_room = used, make_room

    def start(self) -> None:
        self.warm.set()

    def cancel(self) -> bool:
        self.cancelled.set()
        return True


def suite_of(count: int, ahead: int | None = 1) -> list[_Task]:
    """Tasks, of which so many are started ahead."""
    tasks = [_Task() for _ in range(count)]
    SuitePrewarm([cast("list[Prewarm]", tasks)], ahead)
    return tasks


def test_a_system_without_threads_starts_nothing_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, third = suite_of(3)

    def no_room(thread: threading.Thread) -> Any:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_room)
        first.used()
    assert not second.warm.is_set()
    second.used()
    assert third.warm.wait(60)


def test_room_is_made_of_what_is_unused_only() -> None:
    """And there is none where nothing was started ahead; what was passed over is cancelled."""
    first, second, third, fourth = suite_of(4)
    assert not first.make_room()
    first.used()
    assert second.warm.wait(60)
    assert first.make_room()
    assert (first.cancelled.is_set(), second.cancelled.is_set()) == (False, True)
    assert not third.warm.is_set()
    first, second, third, fourth = suite_of(4)
    first.used()
    assert second.warm.wait(60)
    third.used()
    assert second.cancelled.wait(60), "so that there are never more unused jails than permitted"
    assert fourth.warm.wait(60)

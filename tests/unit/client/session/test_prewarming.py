"""What is started ahead is a favour: a request for something else does not fail for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, cast

import pytest

from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.prewarming import Prewarming


class _Task:
    """One environment of a suite, as far as this concerns it."""

    closed = False

    def __init__(self) -> None:
        self.warm = threading.Event()
        self.used: Callable[[], None] = self.warm.set
        self.head_start = self

    def on_first_use(self, used: Callable[[], None], make_room: Callable[[], bool]) -> None:
        """Whom to tell."""
        self.used = used

    def warm_up(self) -> None:
        """It is up."""
        self.warm.set()


def test_a_system_without_threads_starts_nothing_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once there are some again, it does."""
    first, second, third = tasks = [_Task() for _ in range(3)]
    Prewarming([cast("list[EnvSession]", tasks)], 1)

    def no_room(thread: threading.Thread) -> Any:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_room)
        first.used()
    assert not second.warm.is_set()
    second.used()
    assert third.warm.wait(60)

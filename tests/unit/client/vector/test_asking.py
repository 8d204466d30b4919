"""Requests and what is warned of meanwhile: neither hides the other, and no reply is left owed."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any, cast

import pytest

from envhub_sandbox.errors import RemoteEnvWarning
from envhub_sandbox.transport.remote_warnings import RemoteWarnings
from envhub_sandbox.vector.asking import Asking
from envhub_sandbox.vector.suites import EnvSuites


class _Exchange:
    """One that hears a warning with whatever it does."""

    def __init__(self, heard: RemoteWarnings) -> None:
        self.heard = heard
        self.sent = 0
        self.ends_in: BaseException | None = None

    def submit(self, operation: str, message_for: object, instead: object = None) -> None:
        """Sent."""
        self.heard.unshown.append(("Warning", f"sent {self.sent}"))
        self.sent += 1

    def collect(self, timeout_s: float | None) -> list[Any]:
        """Nobody answers."""
        self.heard.unshown.append(("Warning", f"answered {self.sent}"))
        if self.ends_in is not None:
            raise self.ends_in
        return []


def asking() -> tuple[Asking, _Exchange]:
    """With a repository that warns."""
    heard = RemoteWarnings()
    repository = SimpleNamespace(
        heard=heard,
        timeouts=SimpleNamespace(call_s=1.0, reset_s=1.0, step_s=1.0),
        tell=lambda: heard.show("a/b"),
    )
    exchange = _Exchange(heard)
    return Asking(cast("Any", exchange), cast("Any", repository), "Env"), exchange


def test_what_only_sends_is_not_stopped_by_a_filter() -> None:
    """The reply would be owed, and the next request refused."""
    asks, exchange = asking()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asks.submit("call", lambda number, bounds: None)  # type: ignore[arg-type, return-value]
        with pytest.raises(RemoteEnvWarning, match="sent 0"):
            asks.collect(1.0, object)  # type: ignore[type-var]
    assert exchange.sent == 1


def test_a_filter_does_not_hide_a_ctrl_c() -> None:
    """Whoever catches warnings as errors would go on."""
    asks, exchange = asking()
    exchange.ends_in = KeyboardInterrupt()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(KeyboardInterrupt):
            asks.collect(1.0, object)  # type: ignore[type-var]


def test_closing_a_suite_closes_all_of_it() -> None:
    """Whatever one of them raises; and it is raised in the end."""
    closed = []

    def env(name: str) -> Any:
        def close() -> None:
            closed.append(name)
            if name == "a":
                raise RuntimeError("its close")

        return SimpleNamespace(close=close)

    suites = EnvSuites({"s": {0: env("a"), 1: env("b")}}, dict, lambda: closed.append("last"))
    with pytest.raises(RuntimeError, match="its close"):
        suites.close()
    assert closed == ["a", "b", "last"]

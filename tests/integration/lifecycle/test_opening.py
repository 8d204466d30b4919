"""What is asked of the worker server until an environment of a known pin is up."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.transport.connection import WorkerClient
from tests.support.samples import sample


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The requests of this process, by name."""
    names: list[str] = []
    send = WorkerClient.send

    def noted(self: WorkerClient, message: Any, payload: Any = ()) -> int:
        names.append(type(message).__name__)
        return send(self, message, payload)

    monkeypatch.setattr(WorkerClient, "send", noted)
    return names


@pytest.mark.parametrize("shards", [1, 2, 3])
def test_all_shards_start_and_load_side_by_side(asked: list[str], shards: int) -> None:
    """However many there are, it is as many requests: to open, load, build, attach and reset."""
    options: dict[str, Any] = {"n_envs": 3, "use_async_envs": True, "num_workers": shards}
    with make_env(sample("counter"), **options):
        pass  # its manifest is remembered
    asked.clear()
    with make_env(sample("counter"), lane="frames", **options) as suites:
        suites.env.reset(seed=0)
        assert len(suites.env.call("get_wrapper_attr", "spec")) == 3
        asked_until_now = Counter(asked)
    assert asked_until_now == {"Hello": 1, "OpenJail": 1, "Relay": 4}

"""A shard's descriptors get to its runner with the message that is about them, and no other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.transport.jail import JailHandle
from envhub_worker.protocol import messages as m
from tests.support import inside
from tests.support.samples import sample


def test_a_request_in_between_takes_no_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    """They wait at the server for the ``Attach``, whatever else the runner is asked meanwhile."""
    whole, between = JailHandle.exchange, []

    def exchange(
        self: JailHandle,
        operation: str,
        requests: Sequence[tuple[int, Any]],
        deadline: Any,
        *,
        deposited: bool = False,
    ) -> list[m.Message]:
        if deposited:
            asked = [(runner, m.Watch(attach.env, "metadata")) for runner, attach in requests]
            between.append(whole(self, "call", asked, deadline))
        return whole(self, operation, requests, deadline, deposited=deposited)

    monkeypatch.setattr(JailHandle, "exchange", exchange)
    with make_env(sample("cartpole"), n_envs=2) as suites:
        env = suites.env
        env.reset(seed=1)
        env.step(env.action_space.sample())
        assert between
        assert inside.lane(env) is not None

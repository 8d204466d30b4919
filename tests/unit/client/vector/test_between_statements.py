"""Ctrl-C between any two statements: the next request is not held up, nor sent as another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.transport.remote_warnings import RemoteWarnings
from envhub_sandbox.transport.shared_memory import shard
from envhub_sandbox.transport.shared_memory.shard import LaneShard
from envhub_sandbox.vector import vector_env
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs
from tests.attacks.lying_server import env_manifest
from tests.support import inside
from tests.support.interrupts import before_line


class _Session:
    """The life of an environment that answers at once, as far as its face knows of it."""

    def __init__(self) -> None:
        self.manifest = env_manifest()
        timeouts = SimpleNamespace(reset_s=1.0, step_s=1.0, call_s=1.0)
        said = {"timeouts": timeouts, "heard": RemoteWarnings(), "label": "a/b", "copy": True}
        self.repository = SimpleNamespace(**said)
        self.results = SimpleNamespace(one_each=lambda what, replies: replies[0].value)
        self.attributes = SimpleNamespace(known=lambda _: None, wanted=lambda _: False)
        self.exchange = self
        self.pending = ""

    def submit(self, operation: str, message_for: object, instead: object = None) -> None:
        """Owe an answer."""
        assert not self.pending
        self.pending = operation

    def collect(self, timeout_s: float | None) -> list[m.Message]:
        """The answer that is owed."""
        operation, self.pending = self.pending, ""
        return [m.ResetDone(0, {}) if operation == "reset" else m.Value((None,))]

    def finish_reset(self, replies: list[m.ResetDone], timeout_s: float | None) -> Any:
        """The whole of it."""
        return replies[0].observation, {}

    def recover(self) -> None:
        """Drop what is owed."""
        self.pending = ""

    def close(self) -> None:
        """Nothing is left."""

    @contextmanager
    def handling(self) -> Iterator[None]:
        """As it is."""
        yield


@pytest.mark.parametrize(
    "act",
    [
        lambda env: env.reset(),
        lambda env: env.render(),
        lambda env: env.call("here"),
        lambda env: env.set_attr("here", 1),
    ],
    ids=["reset", "render", "call", "set_attr"],
)
def test_an_interrupted_request_leaves_no_wait_that_nobody_can_end(
    act: Callable[[Any], object],
) -> None:
    """A reset brings the environment back, wherever it was."""
    line = 0
    while True:
        env = SandboxVectorEnv(cast("EnvSession", _Session()))
        came = before_line(vector_env.__file__, line, lambda env=env: act(env))  # type: ignore[misc]
        assert env.reset() == (0, {})
        env.close()
        if not came:
            break
        line += 1
    assert line > 3


class _Runner:
    """The other end of a slab: it reads its wishes again where their count has changed."""

    def __init__(self) -> None:
        layout = slabs.layout_of(spaces.Discrete(5), 1)
        assert layout is not None
        self.lane = LaneShard(layout, 0)
        self._changes = 0
        self._wishes: tuple[int, int] = (0, 0)

    def asked(self, dtype: str, slot: int) -> tuple[int, int, int]:
        """What it makes of a step: length of a message, code of the dtype, slot."""
        self.lane.ask([np.zeros(1, dtype)], slot, 0)
        words = inside.request_words(self.lane)
        if words[slabs.CHANGES] != self._changes:
            self._changes = words[slabs.CHANGES]
            self._wishes = words[slabs.DTYPES], words[slabs.SLOT]
        return words[slabs.MESSAGE], *self._wishes


@pytest.mark.parametrize("afterwards", [("int64", 0), ("int32", 1)])
@pytest.mark.parametrize("what", ["step", "message"])
def test_a_runner_is_told_all_after_an_interrupt(what: str, afterwards: tuple[str, int]) -> None:
    """Whether the next step is like the interrupted one, or like the one before it."""
    dtype, slot = afterwards
    expected = (0, slabs.DTYPE_CODES[np.dtype(dtype)], slot)
    line = 0
    while True:
        runner = _Runner()
        lane = runner.lane
        runner.asked("int64", 0)

        def act(lane: LaneShard = lane) -> None:
            if what == "step":
                lane.ask([np.zeros(1, "int32")], 1, 0)
            else:
                lane.tell(b"packet", 1)

        came = before_line(shard.__file__, line, act)
        assert runner.asked(dtype, slot) == expected
        lane.close()
        if not came:
            break
        line += 1
    assert line > 5

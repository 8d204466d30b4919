"""``ENVHUB_TRACE=1``: names of messages, both ways, and no value of them."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator

import pytest

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_sandbox.transport import trace
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import RelayLane
from envhub_sandbox.transport.shared_memory.lane import SharedMemoryLane
from envhub_sandbox.transport.shared_memory.served_lane import ServedLane
from envhub_worker.protocol import messages as m
from tests.attacks.client.lying_server import lying

NAMES = ("send", "receive", "send_step", "send_for_infos", "wait", "replies")
CLASSES = (WorkerConnection, RelayLane, SharedMemoryLane, ServedLane)


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No class is changed yet, and none will be after the test."""
    for cls in CLASSES:
        for name in vars(cls).keys() & set(NAMES):
            monkeypatch.setattr(cls, name, vars(cls)[name])
    importlib.reload(trace)  # it starts once
    yield
    importlib.reload(trace)


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("value", [None, "0", "yes"])
def test_without_the_variable_no_class_is_changed(
    monkeypatch: pytest.MonkeyPatch, value: str | None
) -> None:
    monkeypatch.delenv("ENVHUB_TRACE", raising=False)
    if value is not None:
        monkeypatch.setenv("ENVHUB_TRACE", value)
    before = [dict(vars(cls)) for cls in CLASSES]
    trace.start_if_wanted()
    assert [dict(vars(cls)) for cls in CLASSES] == before


@pytest.mark.usefixtures("fresh")
def test_each_message_is_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once, however often it is asked for; what fails is named by its error."""
    monkeypatch.setenv("ENVHUB_TRACE", "1")
    trace.start_if_wanted()
    trace.start_if_wanted()
    with lying() as server:
        client = WorkerConnection(server.endpoint, server.process_fd)
        client.request(m.Hello(m.VERSION, b"a secret"), deadline=Deadline(60))
        client.request(m.ReadOutput(1, "step"), deadline=Deadline(60))
        with pytest.raises(WorkerTimeoutError):
            client.receive(99, Deadline(0))
        client.close()
    lines = capsys.readouterr().err.splitlines()
    ends = [
        "> WorkerConnection.send Hello",
        "< WorkerConnection.receive Welcome (N ms)",
        "> WorkerConnection.send ReadOutput step",
        "< WorkerConnection.receive Output (N ms)",
        "< WorkerConnection.receive WorkerTimeoutError (N ms)",
    ]
    shown = [re.sub(r"\(\d+\.\d{3} ms\)", "(N ms)", line) for line in lines]
    assert [line.split(" MainThread ")[1] for line in shown] == ends
    assert all(re.match(r"\+\d+\.\d{6} ", line) for line in lines)
    assert "secret" not in "".join(lines)

"""How long a jail has been idle, by what passes the server and what passes its slabs."""

import os
import struct

import pytest

from envhub_worker.protocol.shared_memory.words import SEQUENCE
from envhub_worker.supervisor import records
from envhub_worker.supervisor.records import IdleTimer


def test_steps_past_the_server_count(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(records, "monotonic", lambda: now[0])
    slabs = [os.memfd_create(name) for name in ("request", "reply")]

    def count(asked: int, answered: int) -> None:
        for slab, number in zip(slabs, (asked, answered), strict=True):
            os.pwrite(slab, struct.pack("<Q", number), SEQUENCE * 8)

    timer = IdleTimer(60.0)
    timer.watch(1, [os.dup(slab) for slab in slabs])
    timer.watch(1, [os.memfd_create("of another environment there") for _ in slabs])
    for asked, answered, busy in ((0, 0, False), (1, 0, False), (1, 1, False), (1, 1, True)):
        count(asked, answered)
        now[0] += 59.0
        assert not timer.passed(busy)
    now[0] += 59.0
    assert not timer.passed(busy=False)
    now[0] += 1.0
    assert timer.passed(busy=False)
    timer.begin()
    assert not timer.passed(busy=False)
    timer.close()
    for slab in slabs:
        os.close(slab)

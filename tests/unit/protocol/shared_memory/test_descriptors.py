"""Doorbells: who rings never waits, and a ring that came before the wait counts.
``tests/attacks/protocol/test_slabs.py`` has the memory beside them."""

import os
import select
import socket
from collections.abc import Iterator

import pytest

from envhub_worker.protocol.shared_memory.descriptors import OwnBell, RunnerBell, Watch


@pytest.fixture
def watch() -> Iterator[Watch]:
    made = Watch()
    yield made
    made.close()


def test_a_runner_hears_a_ring() -> None:
    bell = RunnerBell()
    for _ in range(100_000):
        bell.ring()
    assert os.read(bell.theirs, 8) == (1).to_bytes(8, "little")
    copy = os.dup(bell.theirs)
    bell.handed_over()
    bell.handed_over()
    bell.ring()
    os.close(copy)
    bell.ring()  # the runner has gone: that is seen elsewhere
    bell.close()
    bell.close()


def test_a_runner_that_reads_nothing_is_told_of_our_end() -> None:
    bell = RunnerBell()
    copy = os.dup(bell.theirs)
    bell.close()
    assert os.read(copy, 8) == b""
    os.close(copy)


def test_a_ring_before_the_wait_counts(watch: Watch) -> None:
    bell = OwnBell()
    os.eventfd_write(bell.fileno(), 1)
    watch.bell(bell)
    assert watch.wait(60_000) is False
    os.eventfd_write(bell.fileno(), 1)
    watch.forget(bell)
    assert watch.wait(0) is False
    bell.close()


def test_a_death_is_seen_for_as_long_as_it_lasts(watch: Watch) -> None:
    read, write = os.pipe()
    bell = OwnBell()
    watch.bell(bell)
    watch.death(read)
    assert watch.wait(0) is False
    os.close(write)
    os.eventfd_write(bell.fileno(), 1)
    assert [watch.wait(60_000), watch.wait(None)] == [True, True]
    watch.forget(read)
    assert watch.wait(0) is False
    os.close(read)
    bell.close()


def test_a_ring_wakes_once_and_nothing_reaches_our_end() -> None:
    """A jail that rings and is not answered keeps nobody awake; what it sends fails there."""
    own, theirs, watch = OwnBell(), RunnerBell(), Watch()
    watch.bell(own)
    os.eventfd_write(own.fileno(), 1)
    for readable in (True, False):
        assert bool(select.select([watch.fileno()], [], [], 0)[0]) == readable
        watch.wait(0)
    with socket.socket(fileno=os.dup(theirs.theirs)) as end, pytest.raises(BrokenPipeError):
        end.send(b"x")
    for one in (watch, own, theirs):
        one.close()

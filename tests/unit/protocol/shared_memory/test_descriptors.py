"""Memory that is shared with a jail: it keeps its size, and is written by whom it is for.

Doorbells: who rings never waits, and a ring that came before the wait counts.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator

import pytest

from envhub_worker.protocol.shared_memory.descriptors import (
    SEAL_FUTURE_WRITE,
    OwnBell,
    RunnerBell,
    Watch,
    sealed_memfd,
)


@pytest.mark.parametrize("size", [0, 1 << 20])
def test_nobody_changes_its_size(size: int) -> None:
    """A look at what was cut off would be a SIGBUS; the mapping itself is written."""
    mapped, file = sealed_memfd("test", 4096)
    with file, mapped, pytest.raises(PermissionError):
        os.ftruncate(file.fileno(), size)


def test_a_slab_of_ours_is_mapped_by_others_to_be_read() -> None:
    """The control: without the further seal it is mapped writable."""
    for seals in (0, SEAL_FUTURE_WRITE):
        mapped, file = sealed_memfd("test", 4096, seals)
        with file, mapped:
            mapped[0] = 7
            with mmap.mmap(file.fileno(), 4096, prot=mmap.PROT_READ) as other:
                assert other[0] == 7
            if seals:
                with pytest.raises(PermissionError):
                    mmap.mmap(file.fileno(), 4096)
            else:
                mmap.mmap(file.fileno(), 4096).close()


@pytest.fixture
def watch() -> Iterator[Watch]:
    made = Watch()
    yield made
    made.close()


def test_a_runner_hears_a_ring() -> None:
    """However often it is rung before: a bell that nobody answers does not block."""
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

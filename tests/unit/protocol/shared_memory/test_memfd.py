"""Memory that is shared with a jail: it keeps its size, and is written by whom it is for."""

from __future__ import annotations

import mmap
import os

import pytest

from envhub_worker.protocol.shared_memory.memfd import SEAL_FUTURE_WRITE, sealed_memfd


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

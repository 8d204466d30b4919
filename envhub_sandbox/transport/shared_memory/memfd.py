"""Memory that is shared with a jail and that the jail cannot take away.

Followed: ``memfd_create(2)``, ``fcntl(2)`` on sealing.
"""

from __future__ import annotations

import fcntl
import mmap
import os

SEAL_FUTURE_WRITE = 0x10
"""``F_SEAL_FUTURE_WRITE``: nobody else maps it writable."""
_ADD_SEALS = 1033
_SIZE_SEALS = 0x1 | 0x2 | 0x4
"""``F_SEAL_SEAL``, ``F_SEAL_SHRINK`` and ``F_SEAL_GROW``, by number: systems without them import
this file too."""


def slab(name: str, size: int, further_seals: int = 0) -> tuple[mmap.mmap, int]:
    """A sealed memfd of a fixed size, mapped here, and its descriptor.

    Without the seals a jail could cut the memory, and the next look at it would be a SIGBUS.
    """
    fd = os.memfd_create(f"envhub-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    mapped = mmap.mmap(fd, size)
    fcntl.fcntl(fd, _ADD_SEALS, _SIZE_SEALS | further_seals)
    return mapped, fd

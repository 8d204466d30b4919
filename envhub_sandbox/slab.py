"""Memory that is shared with a jail and that the jail cannot take away.

Followed: ``memfd_create(2)``, ``fcntl(2)`` on sealing.
"""

from __future__ import annotations

import fcntl
import mmap
import os

SEAL_FUTURE_WRITE = 0x10
"""``F_SEAL_FUTURE_WRITE``, which ``fcntl`` does not name: nobody else maps it writable."""
_SIZE_SEALS = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW


def slab(name: str, size: int, further_seals: int = 0) -> tuple[mmap.mmap, int]:
    """A sealed memfd of a fixed size, mapped here, and its descriptor.

    Without the seals a jail could cut the memory, and the next look at it would be a SIGBUS.
    """
    fd = os.memfd_create(f"envhub-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    mapped = mmap.mmap(fd, size)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SIZE_SEALS | further_seals)
    return mapped, fd

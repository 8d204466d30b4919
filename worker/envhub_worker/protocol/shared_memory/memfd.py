"""Memory that is shared with a jail and that the jail cannot take away.

Followed: ``memfd_create(2)``, ``fcntl(2)`` on sealing.
"""

from __future__ import annotations

import fcntl
import io
import mmap
import os

SEAL_FUTURE_WRITE = 0x10
"""``F_SEAL_FUTURE_WRITE``: no other process maps it writable."""
_ADD_SEALS = 1033
_SIZE_SEALS = 0x1 | 0x2 | 0x4
"""``F_SEAL_SEAL``, ``F_SEAL_SHRINK`` and ``F_SEAL_GROW``, by number: systems without them import
this file too."""


def sealed_memfd(name: str, size: int, further_seals: int = 0) -> tuple[mmap.mmap, io.FileIO]:
    """A sealed memfd of a fixed size, mapped here, and its file.

    Without the seals a jail could cut the memory, and the next look at it would be a SIGBUS. It is
    a file and no number: interruption.md, rule 5.
    """
    file = io.FileIO(os.memfd_create(f"envhub-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING), "r+")
    file.truncate(size)
    mapped = mmap.mmap(file.fileno(), size)
    fcntl.fcntl(file, _ADD_SEALS, _SIZE_SEALS | further_seals)
    return mapped, file

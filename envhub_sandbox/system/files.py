"""Writes files atomically: others see the old content or the new, and never a part of it."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from envhub_sandbox.system.platform import open_flags

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | open_flags("O_CLOEXEC")


def write_whole_file(path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False) -> None:
    """Write a file under another name, and rename it: meanwhile others read the old one.

    Args:
        mode: Its mode; the umask takes from it.
        durable: Whether it is also whole after a loss of power.

    Raises:
        OSError: It cannot be written. Nothing is left of it.
    """
    part = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    descriptor = os.open(part, _NEW, mode)
    try:
        with open(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            if durable:
                os.fsync(descriptor)
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise

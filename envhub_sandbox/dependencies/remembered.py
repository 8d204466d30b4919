"""Texts that are read off something once, and remembered by the hash of all that they depend on."""

from __future__ import annotations

import contextlib
from pathlib import Path

from envhub_sandbox.system import folders
from envhub_sandbox.system.files import write_whole

_MAX_BYTES = 16 * 1024 * 1024


def recall(folder: Path, key: str) -> str | None:
    """A text, if it is there and only we could have written it."""
    path = folder / key
    try:
        if not folders.is_ours_alone(folder) or path.stat().st_size > _MAX_BYTES:
            return None
        return path.read_text("utf-8")
    except (OSError, ValueError):
        return None


def keep(folder: Path, key: str, text: str) -> None:
    """Remember a text. A cache that cannot be written is no error."""
    with contextlib.suppress(OSError):
        folders.make_private(folder)
        write_whole(folder / key, text.encode())

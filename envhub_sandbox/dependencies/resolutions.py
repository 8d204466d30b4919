"""Remembers which versions were chosen, by everything that the choice depends on.

So the same repository gets the same packages on this machine until somebody asks for newer ones,
and needs no index a second time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from envhub_sandbox import folders
from envhub_sandbox.dependencies import index
from envhub_sandbox.dependencies.declared import Wanted
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.dependencies.resolve import WORKERS, Lock
from envhub_sandbox.hub.store import cache_root
from envhub_sandbox.system.files import write_whole

_FORMAT = 1
_MAX_BYTES = 16 * 1024 * 1024


def root() -> Path:
    """Where they lie; ours alone, since what lies there is installed."""
    return cache_root() / "resolutions"


def key_of(wanted: Sequence[Wanted], interpreter: Interpreter, exclude_newer: str | None) -> str:
    """The name of a resolution: the hash of what it depends on, the places of packages included."""
    asked = sorted(map(str, wanted))
    facts = [_FORMAT, WORKERS, asked, asdict(interpreter), exclude_newer, index.places()]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def recall(key: str) -> Lock | None:
    """What was chosen, if that is known."""
    path = root() / key
    try:
        if not folders.is_ours_alone(path.parent) or path.stat().st_size > _MAX_BYTES:
            return None
        lock = Lock(path.read_text("utf-8"))
        return lock if lock.packages else None  # what the worker needs is in each: it was lost
    except (OSError, ValueError):
        return None


def remember(key: str, lock: Lock) -> None:
    """Keep a choice. A cache that cannot be written is no error."""
    with contextlib.suppress(OSError):
        folders.make_private(root())
        write_whole(root() / key, lock.text.encode())

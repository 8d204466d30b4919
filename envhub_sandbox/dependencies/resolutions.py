"""Remembers which versions were chosen, by everything that the choice depends on.

So the same repository gets the same packages on this machine until somebody asks for newer ones,
and needs no index a second time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from envhub_sandbox import folders
from envhub_sandbox.dependencies import index
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.dependencies.resolve import WORKERS, Lock
from envhub_sandbox.hub.store import cache_root
from envhub_sandbox.system.files import write_whole

_FORMAT = 1
_MAX_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True)
class Resolution:
    """What was chosen for a request.

    Attributes:
        lock: The versions.
        interpreter: What they are for.
    """

    lock: Lock
    interpreter: Interpreter


def root() -> Path:
    """Where they lie; ours alone, since what lies there is installed."""
    return cache_root() / "resolutions"


def key_of(request: PackageRequest, interpreter: Interpreter) -> str:
    """The name of a resolution: the hash of what it depends on, the places of packages included."""
    asked = sorted(map(str, request.wanted))
    facts = [_FORMAT, WORKERS, asked, asdict(interpreter), request.exclude_newer, index.places()]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def recall(key: str, interpreter: Interpreter) -> Resolution | None:
    """What was chosen, if that is known."""
    path = root() / key
    try:
        if not folders.is_ours_alone(path.parent) or path.stat().st_size > _MAX_BYTES:
            return None
        lock = Lock(path.read_text("utf-8"))
        # what the worker needs is in each: an empty one was lost
        return Resolution(lock, interpreter) if lock.packages else None
    except (OSError, ValueError):
        return None


def remember(key: str, found: Resolution) -> None:
    """Keep a choice. A cache that cannot be written is no error."""
    with contextlib.suppress(OSError):
        folders.make_private(root())
        write_whole(root() / key, found.lock.text.encode())

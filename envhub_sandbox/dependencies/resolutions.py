"""Remembers which versions were chosen, by everything that the choice depends on.

So the same repository gets the same packages on this machine until somebody asks for newer ones,
and needs no index a second time.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from envhub_sandbox.dependencies import index, remembered
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.dependencies.resolve import WORKERS, Lock
from envhub_sandbox.hub.store import cache_root

_FORMAT = 2


@dataclass(frozen=True)
class Resolution:
    """What was chosen for a request.

    Attributes:
        lock: The versions.
        interpreter: What they are for.
        taken: Modules that are imported and not declared, and were installed for it.
    """

    lock: Lock
    interpreter: Interpreter
    taken: tuple[str, ...] = ()


def root() -> Path:
    """Where they lie; ours alone, since what lies there is installed."""
    return cache_root() / "resolutions"


def key_of(request: PackageRequest, interpreter: Interpreter) -> str:
    """The name of a resolution: the hash of what it depends on, the places of packages included."""
    asked = [
        sorted(map(str, rows)) for rows in (request.wanted, request.constraints, request.override)
    ]
    asked.append(sorted(str(one.wanted.requirement) for one in request.guesses))
    rest = [request.without, request.exclude_newer, request.python, request.supports, request.gpu]
    facts = [_FORMAT, WORKERS, asked, asdict(interpreter), rest, index.places()]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def recall(key: str) -> Resolution | None:
    """What was chosen, if that is known, and its interpreter is still the same."""
    try:
        facts = json.loads(remembered.recall(root(), key) or "{}")
        lock = Lock(str(facts["lock"]), tuple(map(str, facts["options"])))
        interpreter = Interpreter(**facts["interpreter"])
        # what the worker needs is in each: an empty one was lost
        known = _stamp(interpreter) == facts["stamp"] and all(map(_is_there, lock.options))
        if lock.packages and known:
            return Resolution(lock, interpreter, tuple(map(str, facts["taken"])))
    except (OSError, ValueError, LookupError, TypeError):
        pass
    return None


def remember(key: str, found: Resolution) -> None:
    """Keep a choice. A cache that cannot be written is no error."""
    facts = {
        "lock": found.lock.text,
        "options": found.lock.options,
        "interpreter": asdict(found.interpreter),
        "stamp": _stamp(found.interpreter),
        "taken": found.taken,
    }
    remembered.keep(root(), key, json.dumps(facts))


def _is_there(option: str) -> bool:
    """Whether a folder of wheels that were built is where it was."""
    return os.sep not in option or os.path.isdir(option)


def _stamp(interpreter: Interpreter) -> list[int]:
    """Another release under the same name is another file."""
    status = os.stat(interpreter.path)
    return [status.st_size, status.st_mtime_ns]

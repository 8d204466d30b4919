"""Wheels that were built here, by what they were built of.

::

    <cache>/wheels/<source and interpreter>/<build environment>/
        NAME-VERSION-TAGS.whl
        built.json      what it was built of, and its hash
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path

from envhub_sandbox.dependencies.builds.sources import Source, WheelOrigin
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.hub.cache import cache_root, draft, remove_tree
from envhub_sandbox.hub.hashing import SHA256, HashMismatch, digest_of
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.system import folders

FORMAT = 2
"""Of what is kept, and of how it is built: another one is built again."""


def root() -> Path:
    """Where they lie; ours alone, since what lies there is installed."""
    return cache_root() / "wheels"


def recall(source: Source, interpreter: Interpreter) -> Path | None:
    """The wheel of a source that was built last for an interpreter; None where there is none."""
    place = root() / _key(source, interpreter)
    if not place.is_dir() or not folders.is_ours_alone(root()):
        return None
    records = sorted(place.glob("[!.]*/built.json"), key=lambda one: -one.stat().st_mtime)
    return next(filter(None, map(_whole, records)), None)


def _whole(record: Path) -> Path | None:
    """The wheel beside a record, if it is what that one says."""
    with contextlib.suppress(OSError, ValueError, HashMismatch):
        [wheel] = record.parent.glob("*.whl")
        built = describe(wheel)
        return wheel if built is not None and _hash(wheel) == f"sha256:{built.wheel}" else None
    return None


def describe(wheel: Path) -> WheelOrigin | None:
    """What a wheel was built of; None for one that was not built here."""
    with contextlib.suppress(OSError, ValueError, TypeError, LookupError):
        facts = json.loads((wheel.parent / "built.json").read_bytes())
        return WheelOrigin(Source(**facts["source"]), facts["environment"], facts["wheel"])
    return None


def keep(wheel: Path, source: Source, environment: str, interpreter: Interpreter) -> Path:
    """Keep a wheel that was checked, and return where it lies. Raises ``DependencyError``."""
    place = root() / _key(source, interpreter)
    public = replace(source, url=without_login(source.url), where="")
    built = WheelOrigin(public, environment, _hash(wheel).removeprefix("sha256:"))
    try:
        folders.make_private(root())
        folders.make(place)
        with draft(place) as building:
            shutil.copyfile(wheel, building / wheel.name)
            (building / "built.json").write_text(json.dumps(asdict(built)))
            home = place / environment[:40]
            if home.exists() and _whole(home / "built.json") is None:
                remove_tree(home)
            with contextlib.suppress(OSError):  # one that another has put there is as good
                os.rename(building, home)
    except OSError as error:
        raise DependencyError(f"{root()} cannot be written: {error}") from error
    kept = recall(source, interpreter)
    assert kept is not None
    return kept


def _key(source: Source, interpreter: Interpreter) -> str:
    facts = json.dumps([FORMAT, source.identity, asdict(interpreter)])
    return hashlib.sha256(facts.encode()).hexdigest()[:40]


def _hash(wheel: Path) -> str:
    return digest_of(wheel, SHA256, wheel.stat().st_size)

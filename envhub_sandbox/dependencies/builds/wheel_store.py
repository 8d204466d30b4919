"""Wheels that were built here, by what they were built of.

::

    <cache>/wheels/<source and interpreter>/<build environment>/
        NAME-VERSION-TAGS.whl
        built.json      the hashes of all of these
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.hub.store import cache_root, remove_tree
from envhub_sandbox.system import folders

FORMAT = 1
"""Of what is kept, and of how it is built: another one is built again."""
_BUILDING = ".building-"


@dataclass(frozen=True)
class Built:
    """A wheel that was built here.

    Attributes:
        source: What it was built of: ``sha256:`` and the hash of a file, or a commit of git.
        url: Where that was found.
        environment: Of the lock of the packages that it was built with.
        sha256: Its own.
        name: Its file's name.
    """

    source: str
    url: str
    environment: str
    sha256: str
    name: str


def root() -> Path:
    """Where they lie; ours alone, since what lies there is installed."""
    return cache_root() / "wheels"


def recall(source: str, interpreter: Interpreter) -> Path | None:
    """The wheel of a source that was built last for an interpreter; None where there is none."""
    place = root() / _key(source, interpreter)
    if not place.is_dir() or not folders.is_ours_alone(root()):
        return None
    records = sorted(place.glob("[!.]*/built.json"), key=lambda one: -one.stat().st_mtime)
    return next(filter(None, map(_whole, records)), None)


def _whole(record: Path) -> Path | None:
    """The wheel of a record, if it is what that one says."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        built = Built(**json.loads(record.read_bytes()))
        wheel = record.parent / os.path.basename(built.name)
        return wheel if _hash(wheel) == built.sha256 else None
    return None


def describe(wheel: Path) -> Built | None:
    """What a wheel was built of; None for one that was not built here."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        return Built(**json.loads((wheel.parent / "built.json").read_bytes()))
    return None


def keep(wheel: Path, source: str, url: str, environment: str, interpreter: Interpreter) -> Path:
    """Keep a wheel that was checked, and return where it lies.

    Raises:
        DependencyError: The cache cannot be written.
    """
    place = root() / _key(source, interpreter)
    built = Built(source, url, environment, _hash(wheel), wheel.name)
    try:
        folders.make_private(root())
        folders.make(place)
        with _draft(place) as draft:
            shutil.copyfile(wheel, draft / wheel.name)
            (draft / "built.json").write_text(json.dumps(asdict(built)))
            _publish(draft, place / environment[:40])
    except OSError as error:
        raise DependencyError(f"{root()} cannot be written: {error}") from error
    kept = recall(source, interpreter)
    assert kept is not None
    return kept


def _publish(draft: Path, home: Path) -> None:
    if home.exists() and _whole(home / "built.json") is None:
        remove_tree(home)
    with contextlib.suppress(OSError):  # one that another has put there is as good
        os.rename(draft, home)


@contextlib.contextmanager
def _draft(place: Path) -> Iterator[Path]:
    draft = Path(tempfile.mkdtemp(prefix=_BUILDING, dir=place))
    try:
        yield draft
    finally:
        if draft.exists():
            remove_tree(draft)


def _key(source: str, interpreter: Interpreter) -> str:
    facts = json.dumps([FORMAT, source, asdict(interpreter)])
    return hashlib.sha256(facts.encode()).hexdigest()[:40]


def _hash(wheel: Path) -> str:
    with wheel.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()

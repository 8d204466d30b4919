"""Tells when a repository was written: later packages may break it, those of that day cure it.

Trust: a date is a stranger's word, and only decides which releases of packages a jail gets.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import (
    DependencyError,
    EnvHubError,
    LoadError,
    PolicyError,
    RemoteEnvError,
)
from envhub_sandbox.extras.packages.request import AS_WRITTEN, Choice
from envhub_sandbox.extras.sources import registered
from envhub_sandbox.hub import store
from envhub_sandbox.hub.answers import HubFailure
from envhub_sandbox.hub.grammar import REPO_TYPES
from envhub_sandbox.hub.listing import Repository
from envhub_sandbox.hub.reference import GIT
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import option_name

_OUTDATED = re.compile(
    r"has no attribute|unexpected keyword argument|required positional|positional arguments?\b|"
    r"cannot import name|No module named '\w+\.|"
    r"(?i:\b(?:removed|renamed|moved to|no longer|deprecated)\b)"
)
_FRAME_FILE = r'(?m)^[ |+-]*File "?([^"\n]+)"?, line \d+'
_BROKEN_BY = {
    r"removed in the NumPy 2\.0 release": ("numpy<2", "3.12", "2024-06-16"),
    r"module 'numpy' has no attribute '(bool|complex|float|int|object|str)'": (
        *("numpy<1.24", "3.11"),
        "2022-12-18",
    ),
}
"""Maps a pattern of an error to a requirement for an earlier release, the newest Python that this
has wheels for, and the day of the break."""
_MISSING_TOP = re.compile(r"^ModuleNotFoundError: No module named '\w+'")
_RECENT = timedelta(days=30)
_MOST_DATES, _MOST_TEXT = 4, 65_536


def of_its_day(
    snapshot: Snapshot,
    error: EnvHubError,
    resolves: Callable[[Mapping[str, Any]], bool] = lambda keys: True,
) -> str:
    """Returns advice for an error at a start that packages of the repository's day may cure; empty
    for other errors, and for a repository of today. ``resolves`` tells whether there are versions
    with keys of ``dependencies``: only such keys are named.
    """
    text, days = _said_at_start(error), days_for(snapshot, error)
    for pattern, (requirement, python, broken) in _BROKEN_BY.items():
        if re.search(pattern, text) and (not days or days[0] >= broken):
            keys = next(filter(resolves, _earlier(requirement, python)), None)
            if keys is None:
                return f"A later release of a package has broken it, and {requirement} does not fit"
            older = option_name("dependencies", keys)
            return f"A later release of a package has broken it; {older} takes an earlier one"
    day = next((day for day in days if resolves({"exclude_newer": day})), "")
    if not day:
        return ""
    old = option_name("dependencies", {"exclude_newer": day})
    return (
        f"It is of {days[0]}. If packages have changed since, {old} gives it those of that day; "
        "'envhub check' looks for a later day that does"
    )


def _earlier(requirement: str, python: str) -> Iterator[dict[str, Any]]:
    """Yields keys of ``dependencies`` that take an earlier release: the least change first."""
    # "extra" first: then the other packages are chosen to fit the earlier release
    ways: tuple[dict[str, Any], ...] = ({"extra": [requirement]}, {"override": [requirement]})
    yield from ways
    yield from ({**way, "python": python, "fetch_python": True} for way in ways)


def settled(snapshot: Snapshot, choice: Choice) -> Choice:
    """Replaces ``"auto"`` in a choice by the date. Raises ``PolicyError``: the date is unknown."""
    if choice.exclude_newer != AS_WRITTEN:
        return choice
    if day := written(snapshot):
        return replace(choice, exclude_newer=day)
    raise PolicyError(
        f"{snapshot.label}: the day on which it was written is not known; give a date, as in "
        f"{option_name('dependencies', {'exclude_newer': '2026-01-31'})}"
    )


def written(snapshot: Snapshot) -> str:
    """Returns the day of the commit, release or newest file, ``"2024-05-31"``; empty if unknown."""
    day = ""
    with contextlib.suppress(EnvHubError, HubFailure, OSError, ValueError, LookupError):
        if snapshot.is_local:
            day = _of_files(snapshot)
        elif snapshot.repo_type == registered.KIND:
            day = _of_release(snapshot)
        elif snapshot.repo_type in (*REPO_TYPES, GIT):
            day = _of_commit(snapshot)
        return date.fromisoformat(day).isoformat()
    return ""


def days_for(snapshot: Snapshot, error: EnvHubError) -> list[str]:
    """Returns days whose packages may cure an error: the day on which the repository was written,
    and a few later ones, each halving the distance to today.
    """
    day = written(snapshot) if _may_be_outdated(error) else ""
    now = datetime.now(timezone.utc)
    then = datetime.fromisoformat(day or now.date().isoformat()).replace(tzinfo=timezone.utc)
    days: list[str] = []
    while now - then > _RECENT and len(days) < _MOST_DATES:
        days.append(then.date().isoformat())
        then += (now - then) / 2
    return days


def _may_be_outdated(error: EnvHubError) -> bool:
    """Tells whether older packages may cure an error: its text or traceback points to a package."""
    message = _said_at_start(error)
    remote = _remote(error)
    if not message or remote is None or isinstance(remote, (OSError, EOFError, MemoryError)):
        return False
    if _MISSING_TOP.search(message):
        return False  # an earlier release of another package brings no module
    raised_in = re.findall(_FRAME_FILE, remote.traceback)[-1:]
    return bool(_OUTDATED.search(message)) or any("/packages/" in file for file in raised_in)


def _said_at_start(error: EnvHubError) -> str:
    """Returns the text of an error at loading or reset; empty for any other error.
    Trust: text from the worker, which only selects one of our sentences.
    """
    remote = _remote(error)
    if remote is None:
        return ""
    starts = isinstance(error, (LoadError, DependencyError)) or ", in reset" in remote.traceback
    return f"{remote.type_name}: {remote.message}"[:_MOST_TEXT] if starts else ""


def _remote(error: EnvHubError) -> RemoteEnvError | None:
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    return remote if isinstance(remote, RemoteEnvError) else None


def _of_files(snapshot: Snapshot) -> str:
    folder = Path(snapshot.repo_id)
    paths = [folder / file.path for file in snapshot.files] if folder.is_dir() else [folder]
    newest = max(os.stat(path).st_mtime for path in paths)
    return datetime.fromtimestamp(newest, timezone.utc).strftime("%Y-%m-%d")


@lru_cache(maxsize=8)
def _of_release(snapshot: Snapshot) -> str:
    from envhub_sandbox.extras.packages import interpreters
    from envhub_sandbox.extras.packages.declared import declared
    from envhub_sandbox.extras.packages.resolution import resolve

    says = declared(snapshot.root, snapshot.path)
    assert says is not None  # the entry file is ours
    return resolve.uploaded(says.wanted[0], interpreters.own().path)


@lru_cache(maxsize=8)
def _of_commit(snapshot: Snapshot) -> str:
    from envhub_sandbox.extras.sources import git_commits
    from envhub_sandbox.hub.client import HubClient

    if snapshot.repo_type == GIT:
        return git_commits.day_of(snapshot.repo_id, snapshot.commit)
    # only its own host is asked: a private repository's name must not leave it
    repo = Repository(snapshot.repo_type, snapshot.repo_id)
    return HubClient(store.endpoint_of(snapshot.root)).changed(repo, snapshot.commit)

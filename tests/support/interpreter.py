"""Who may read the interpreter of the tests, and so which profiles can be tested with it.
Root's jails run as another user. With a private root they are shown the interpreter; without one
that user needs the host's permission to read it, which one below ``/root`` does not give."""

import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import envhub_worker

_WITHOUT_PRIVATE_ROOT = {"no-userns", "container"}


def can_run(profile: str) -> bool:
    """Whether jails of a profile can read the interpreter."""
    return profile not in _WITHOUT_PRIVATE_ROOT or os.getuid() != 0 or not _closed()


def profiles(*names: str) -> list[Any]:
    """Parameters of a test or a fixture: each profile, skipped where it cannot run."""
    return [pytest.param(name, marks=() if can_run(name) else _SKIP) for name in names]


def needs(profile: str) -> pytest.MarkDecorator:
    """For a test that runs jails of one profile: skipped where it cannot."""
    return pytest.mark.skipif(not can_run(profile), reason=_REASON)


def ways_to_it() -> list[Path]:
    """The folders and files that an interpreter in a jail is shown, as they are named here."""
    import_path = [Path(entry) for entry in sys.path if entry and Path(entry).exists()]
    ours = [Path(sys.prefix), Path(sys.base_prefix), Path(envhub_worker.__file__).parent]
    return [named for path in (*ours, *import_path) for named in (path.absolute(), path.resolve())]


def _closed() -> list[Path]:
    """What of the interpreter other users may not read, as ``lockdown.outer`` asks it."""
    asked = (os.__file__, sys.prefix, envhub_worker.__file__)
    return [Path(path) for path in asked if not all(_permits(Path(path)))]


def _permits(path: Path) -> Iterator[bool]:
    yield bool(path.stat().st_mode & stat.S_IROTH)
    for folder in path.resolve().parents:
        yield bool(folder.stat().st_mode & stat.S_IXOTH)


_REASON = "root's jails without a private root cannot read this interpreter; try /usr/bin/python3"
_SKIP = pytest.mark.skip(reason=_REASON)

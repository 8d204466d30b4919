"""What a repository runs with: an interpreter of this machine, a folder of packages, and the
contents of its Hub cache (``HubCopy``).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from envhub_worker.protocol.errors import RemoteProtocolError

MAX_HUB_COPIES = 17
"""The repository's own files, and sixteen others."""
_FOLDER = r"(?a)(models|datasets|spaces)(--[A-Za-z0-9_][\w.-]{0,95}){1,2}"
_COMMIT = r"[0-9a-f]{40}"
_STEP = r"\w[\w.+#=@%,-]{0,99}"
_REVISION = rf"(?a){_STEP}(/{_STEP}){{0,4}}"
_MAX_REVISIONS = 4
_MAX_PATH = 4096
_TABLES = (
    *("MAPPING", "NAMESPACES"),  # setuptools
    "_redirections",  # editables, which Hatch and PDM use
    *("known_source_files", "submodule_search_locations"),  # scikit-build-core
)
"""Where the finders of ``pip install -e`` say which module lies where."""


class Runtime(NamedTuple):
    """An interpreter and a folder of packages.

    No dataclass: a server needs it before it starts its zygote, and ``dataclasses`` imports
    ``inspect``.

    Attributes:
        python: Absolute path of the interpreter. It belongs to the machine and is trusted; empty
            for the worker server's own.
        packages: Absolute path of a folder as ``uv pip install --target`` makes it. Its code is
            as untrusted as the repository's and runs only in jails. Empty for the interpreter's
            own packages, which are trusted.
    """

    python: str
    packages: str = ""


RECORD = "environment.json"
"""A file beside a folder of packages. A process that uses the packages holds a shared lock on it,
one that removes them an exclusive one. No jail sees it."""

OWN = Runtime("")
"""The worker server's own interpreter, with its packages."""


def site_options() -> list[str]:
    """Returns the options that tell ``bootstrap.py`` where ``pip install --user`` puts packages."""
    import site

    folder = site.getusersitepackages()
    return ["--user-site", folder] if folder in sys.path else []


def mapped_modules(finders: Iterable[object]) -> dict[str, tuple[str, ...]]:
    """Returns the paths of editable modules by full name, read from finders (``sys.meta_path``).

    The finders' tables are read as data; no finder runs. A path may lack its suffix: setuptools
    writes that of a single-file module without.
    """
    folders: dict[str, tuple[str, ...]] = {}
    for table in _tables(finders):
        for name, paths in table.items():
            each = paths if isinstance(paths, (list, tuple, set)) else (paths,)
            texts = tuple(str(p) for p in each if isinstance(p, str) or hasattr(p, "__fspath__"))
            if isinstance(name, str) and texts:  # any finder may have a table of this name
                folders[name] = folders.get(name, ()) + texts
    return folders


def _tables(finders: Iterable[object]) -> Iterator[Mapping[str, Any]]:
    for finder in finders:
        module = sys.modules.get(getattr(finder, "__module__", ""))
        for holder in (finder, module):
            tables = (getattr(holder, "__dict__", {}).get(name) for name in _TABLES)
            yield from (table for table in tables if isinstance(table, dict))


class HubCopy(NamedTuple):
    """One repository of a jail's own cache of the Hub, at one commit.

    Attributes:
        folder: The repository's folder name in the Hub cache: ``"models--org--name"``.
        commit: The full commit.
        revisions: Branches and tags that point to this commit.
        tree: The folder with its files; empty if they are those of the jail's own snapshot.
    """

    folder: str
    commit: str
    revisions: tuple[str, ...]
    tree: str


def is_cached_revision(text: str) -> bool:
    """Whether ``HubCopy.revisions`` may hold a name. It becomes a path in the cache, so fewer names
    are allowed than in git.
    """
    return re.fullmatch(_REVISION, text) is not None


def read_hub_copies(value: Any) -> tuple[HubCopy, ...]:
    """Reads the Hub copies of an ``OpenJail``; lists may stand for tuples.

    Trust: a client on another host may have written them.

    Raises:
        RemoteProtocolError: A name or a number is invalid.
    """
    if type(value) not in (list, tuple) or len(value) > MAX_HUB_COPIES:
        raise _wrong()
    copies = tuple(map(_copy, value))
    if len({copy.folder for copy in copies}) < len(copies):
        raise _wrong()
    return copies


def _copy(value: Any) -> HubCopy:
    if type(value) not in (list, tuple) or len(value) != 4:
        raise _wrong()
    folder, commit, revisions, tree = value
    if type(revisions) not in (list, tuple) or len(revisions) > _MAX_REVISIONS:
        raise _wrong()
    texts = (folder, commit, tree, *revisions)
    if not all(type(text) is str for text in texts) or len(tree) > _MAX_PATH or "\0" in tree:
        raise _wrong()
    matches = re.fullmatch(_FOLDER, folder) and re.fullmatch(_COMMIT, commit)
    if not matches or not all(map(is_cached_revision, revisions)):
        raise _wrong()
    return HubCopy(folder, commit, tuple(revisions), tree)


def _wrong() -> RemoteProtocolError:
    return RemoteProtocolError("the copies of Hub repositories are malformed")

"""What of a folder is one file's own: the file, and the modules and packages that it imports.

A package is taken whole, with its data; a folder without ``__init__.py`` is nobody's, so of it only
modules are taken that are imported by name: else a stranger's file had any folder by importing it.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from envhub_sandbox.extras.sources import parsing
from envhub_sandbox.extras.sources.checkout import Checkout

_INIT = "__init__.py"
_MACHINE_CODE = (".so", ".pyd")
_MOST_ROUNDS = 100
"""How far imports are followed; each takes a process."""

_MOST_KNOWN = 100
_KNOWN: dict[bytes, parsing.ParsedFile | None] = {}

Names = Callable[[str], Collection[str]]
"""The names of the files in a folder, which is written with ``/``."""


def _names_below(root: Path) -> Names:
    """Gives the names of the files in a folder below ``root``; no link counts, or is followed."""

    @functools.cache
    def names(folder: str) -> Collection[str]:
        path = root / folder
        is_plain = not folder or all(map(str.isidentifier, folder.split("/")))
        if not is_plain or os.path.realpath(path) != str(path):
            return ()
        try:
            with os.scandir(path) as listing:
                return frozenset(
                    item.name for item in listing if item.is_file(follow_symlinks=False)
                )
        except OSError:
            return ()

    return names


def own_files(root: Path, entry: str, checkout: Checkout | None) -> set[str]:
    """The paths of a file's own below ``root``; of a package its folder, with a slash at its end.
    Nothing is imported or run.
    """
    names = _names_below(root) if checkout is None else checkout.names_in
    files, waiting, left = set[str](), {entry}, parsing.MOST_BYTES_IN_ALL
    for _ in range(_MOST_ROUNDS):
        files |= waiting
        texts = {}
        for file in sorted(waiting):
            data = parsing.content(root / file, min(left, parsing.MOST_BYTES))
            if data is not None and file.endswith(".py"):
                texts[file] = data
                left -= len(data)
        read = _read(texts)
        waiting = {
            path
            for file, parsed_file in read.items()
            if parsed_file
            for path in _imported(file, parsed_file, names)
        }
        waiting -= files
        if not waiting or None in read.values():  # what took too much once is not tried on and on
            break
    return {_package_of(path, names) or path for path in files | waiting}


def _read(texts: dict[str, bytes]) -> dict[str, parsing.ParsedFile | None]:
    """What each text is; one that was read in this process before is not parsed again."""
    parsed_before = dict(_KNOWN)  # other threads may read files, too
    found = parsing.parsed(
        {file: text for file, text in texts.items() if text not in parsed_before}
    )
    if len(parsed_before) > _MOST_KNOWN:
        _KNOWN.clear()
    _KNOWN.update((texts[file], one) for file, one in found.items())
    return {
        file: found[file] if file in found else parsed_before[text] for file, text in texts.items()
    }


def _imported(file: str, read: parsing.ParsedFile, names: Names) -> Iterator[str]:
    for statement in read.imports:
        folder, dotted = parsing.named_modules(statement, file)
        for module in dotted:
            for path in parsing.candidates(module, folder):
                for own in _files_of(path, names):
                    yield own
                    yield from (f"{package}/{_INIT}" for package in _packages_around(own, names))


def _files_of(path: str, names: Names) -> Iterator[str]:
    """A module's source, and machine code that Python would import in place of it."""
    folder, _, name = path.rpartition("/")
    below, begin = f"{folder}/" if folder else "", name.removesuffix("py")
    for other in names(folder):
        if other == name or (other.startswith(begin) and other.endswith(_MACHINE_CODE)):
            yield below + other


def _packages_around(path: str, names: Names) -> Iterator[str]:
    """The packages that a file lies in, the innermost first; the folder itself is none."""
    folder = path.rpartition("/")[0]
    while folder:
        if _INIT in names(folder):
            yield folder
        folder = folder.rpartition("/")[0]


def _package_of(path: str, names: Names) -> str:
    outermost = [*_packages_around(path, names)][-1:]
    return f"{outermost[0]}/" if outermost else ""

"""Finds the files in a folder that belong to one file: itself, and the modules that it imports.

A package belongs to it as a whole, with its data. A folder without ``__init__.py`` is no package,
so only its imported modules do: else a stranger's file could claim any folder by an import.
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
"""Rounds in which imports are followed; each round starts a process."""

_MOST_KNOWN = 100
_KNOWN: dict[bytes, parsing.ParsedFile | None] = {}

Names = Callable[[str], Collection[str]]
"""Returns the names of the files in a folder, a path with ``/``."""


def _names_below(root: Path) -> Names:
    """Returns a function that lists the files in a folder below ``root``; ignores links."""

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
    """Returns the paths below ``root`` that belong to a file; for a package its folder, with a
    slash at its end. Imports and runs nothing.
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
        if not waiting or None in read.values():  # no second attempt for a file that cost too much
            break
    return {_package_of(path, names) or path for path in files | waiting}


def _read(texts: dict[str, bytes]) -> dict[str, parsing.ParsedFile | None]:
    """Parses each text, unless this process has parsed it before."""
    parsed_before = dict(_KNOWN)  # a copy, since other threads may parse files too
    fresh = parsing.parsed(
        {file: text for file, text in texts.items() if text not in parsed_before}
    )
    if len(parsed_before) > _MOST_KNOWN:
        _KNOWN.clear()
    _KNOWN.update((texts[file], one) for file, one in fresh.items())
    return {
        file: fresh[file] if file in fresh else parsed_before[text] for file, text in texts.items()
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
    """Yields a module's source, and machine code that Python would import in its place."""
    folder, _, name = path.rpartition("/")
    below, begin = f"{folder}/" if folder else "", name.removesuffix("py")
    for other in names(folder):
        if other == name or (other.startswith(begin) and other.endswith(_MACHINE_CODE)):
            yield below + other


def _packages_around(path: str, names: Names) -> Iterator[str]:
    """Yields the packages around a file, the innermost first; never the root folder."""
    folder = path.rpartition("/")[0]
    while folder:
        if _INIT in names(folder):
            yield folder
        folder = folder.rpartition("/")[0]


def _package_of(path: str, names: Names) -> str:
    outermost = [*_packages_around(path, names)][-1:]
    return f"{outermost[0]}/" if outermost else ""

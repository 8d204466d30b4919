"""A file system without case, such as macOS and Windows have, for one folder of this process."""

import contextlib
import io
import os
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

_ONE_PATH = ("stat", "lstat", "open", "mkdir", "unlink", "scandir", "chmod", "access", "rmdir")


@contextlib.contextmanager
def without_case(folder: Path) -> Iterator[None]:
    """Below a folder, names that differ in case or in Unicode's form are one file meanwhile."""
    root = os.path.realpath(folder)
    listed = os.listdir

    def known(path: Any) -> Any:
        try:
            text = os.path.abspath(os.fspath(path))
        except TypeError:
            return path
        if not text.startswith(f"{root}/"):
            return path
        here = root
        for step in text[len(root) + 1 :].split("/"):
            same = [one for one in _names(here) if _folded(one) == _folded(step)]
            here = os.path.join(here, *(same or [step])[:1])
        return here

    def _names(place: str) -> list[str]:
        try:
            return listed(place)
        except OSError:
            return []

    def folding(call: Any, paths: int) -> Any:
        def called(*given: Any, **named: Any) -> Any:
            return call(*map(known, given[:paths]), *given[paths:], **named)

        return called

    with pytest.MonkeyPatch.context() as patch:
        for name in _ONE_PATH:
            patch.setattr(os, name, folding(getattr(os, name), 1))
        for name in ("rename", "replace"):
            patch.setattr(os, name, folding(getattr(os, name), 2))
        patch.setattr(io, "open", folding(io.open, 1))
        yield


def _folded(name: str) -> str:
    return unicodedata.normalize("NFD", name).casefold()

"""Names of files that this platform, or one of its file systems, reads as another name.

A repository is made on Linux, where a name is bytes. On Windows ``C:\\x`` is no name but a place
outside of the folder, ``env.py:x`` a part of ``env.py``, ``con.py`` a terminal and ``env.py.`` the
file ``env.py``. macOS and Windows take ``Env.py`` and ``env.py`` for one file, unless the file
system was made otherwise, and so do some file systems on Linux.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import unicodedata
from collections.abc import Iterable
from pathlib import Path

from envhub_sandbox.system.platform import IS_WINDOWS

_RESERVED = re.compile(
    r"(?i:con|prn|aux|nul|conin\$|conout\$|(?:com|lpt)[0-9\u00b9\u00b2\u00b3])[ ]*(?:[.:].*)?"
)
_REFUSED = re.compile(r'[<>:"|?*\\\x00-\x1f]')


def wrong_on_windows(path: str) -> str | None:
    """Why Windows has no file of this name, as the rest of a sentence; None if it can.
    ``path``: relative, with ``/``.
    """
    for step in path.split("/"):
        if found := _REFUSED.search(step):
            return f"has {found[0]!r} in its name, which Windows reads as something else"
        if _RESERVED.fullmatch(step):
            return f"has the step {step!r}, which is a device on Windows"
        if step.endswith((".", " ")):
            return f"has the step {step!r}, of which Windows drops the end"
    return None


def wrong_here(path: str) -> str | None:
    """The same on Windows; None elsewhere."""
    return wrong_on_windows(path) if IS_WINDOWS else None


def taken_as_one(paths: Iterable[str]) -> tuple[str, str] | None:
    """Two of these, or of the folders above them, that a file system without case takes for one."""
    known: dict[str, str] = {}
    for path in paths:
        folded = name = ""
        for step in path.split("/"):
            folded, name = f"{folded}/{_folded(step)}", f"{name}/{step}" if name else step
            other = known.setdefault(folded, name)
            if other != name:
                return other, name
    return None


def _folded(step: str) -> str:
    return unicodedata.normalize("NFD", unicodedata.normalize("NFD", step).casefold())


def ignores_case(folder: Path) -> bool:
    """Whether the file system of a folder takes two names that differ in case for one.

    Found out with a file of ours, for a platform has file systems of both kinds.
    Raises ``OSError``: the folder cannot be written.
    """
    probe = folder / f".envhub-case-{secrets.token_hex(4)}"
    os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    try:
        return os.path.lexists(probe.with_name(probe.name.upper()))
    finally:
        with contextlib.suppress(OSError):
            os.unlink(probe)

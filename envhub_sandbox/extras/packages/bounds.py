"""How large an environment may become, and how much of the disk it has to leave free.

A small file on an index can be unpacked to a disk's worth. So uv is watched: by what it says that
it downloads, by what lies in the folder, and by what is left of the disks that it writes to; and
the kernel ends it at a single file over the bound.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.errors import DependencyError
from envhub_worker.protocol.text import size_text

BYTES_VARIABLE = "ENVHUB_ENVIRONMENT_BYTES"
FILES_VARIABLE = "ENVHUB_ENVIRONMENT_FILES"
MAX_BYTES = 16 * 2**30
MAX_FILES = 400_000
LEFT_FREE = 64 * 2**20
"""Bytes of a disk that are left to everybody else."""
_ANNOUNCED = re.compile(r"Downloading (\S{1,200}) \((\d{1,9}(?:\.\d{1,9})?)([KMGT]iB)\)")
_UNITS = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}


@dataclass(frozen=True)
class Bounds:
    """What one environment may have: bytes (before bytecode is made), and files with folders."""

    bytes: int
    files: int

    @classmethod
    def set(cls) -> Bounds:
        """Those of this machine's user; ``DependencyError`` if a variable holds no number."""
        return cls(_number(BYTES_VARIABLE, MAX_BYTES), _number(FILES_VARIABLE, MAX_FILES))

    def check(self, size: int, files: int, subject: str) -> None:
        """Refuse more with ``DependencyError``."""
        if size > self.bytes:
            raise DependencyError(
                f"{subject} {size_text(size)}; at most {size_text(self.bytes)} are installed. No "
                f"environment was made. If you accept the size, set {BYTES_VARIABLE} to more bytes",
                reason="size",
            )
        if files > self.files:
            raise DependencyError(
                f"{subject} {files} files; at most {self.files} are installed. No environment was "
                f"made. If you accept the size, set {FILES_VARIABLE} to more",
                reason="size",
            )


def _number(variable: str, usual: int) -> int:
    text = os.environ.get(variable) or str(usual)
    if not re.fullmatch(r"[1-9]\d{0,17}", text):
        raise DependencyError(f"{variable} is {text[:80]!r}; it takes a number")
    return int(text)


class Watch:
    """Looks at an installation in progress: at its folder, and at the disks that uv writes to."""

    def __init__(self, bounds: Bounds, folder: Path, places: Sequence[Path]) -> None:
        self.bounds = bounds
        self._folder = folder
        self._places = [
            next(path for path in (place, *place.parents) if path.exists())
            for place in (folder, *places)
        ]
        self._announced = 0

    def hear(self, line: str) -> None:
        """Note what uv says that it downloads: a package is no smaller once it is unpacked."""
        if match := _ANNOUNCED.fullmatch(line):
            self._announced += int(float(match[2]) * _UNITS[match[3]])

    def look(self) -> None:
        """Refuse to go on over a bound, or where a disk is as good as full."""
        self.bounds.check(self._announced, 0, "its packages are downloads of")
        self.bounds.check(*measured(self._folder), "its packages have")
        for place in self._places:
            free = shutil.disk_usage(place).free
            if free < LEFT_FREE:
                raise DependencyError(
                    f"the disk of {place} is full: {free // 2**20} MiB are free, and "
                    f"{LEFT_FREE // 2**20} are needed. 'envhub cache remove --unused-for 30' "
                    "removes what was not used for 30 days, 'uv cache prune' cleans uv's cache"
                )


def measured(folder: Path) -> tuple[int, int]:
    """Bytes and number of all that is below a folder; what vanishes meanwhile counts nothing."""
    size = count = 0
    for path in walk(folder):
        try:
            size += path.lstat().st_size
            count += 1
        except FileNotFoundError:
            continue
    return size, count


def checked(folder: Path) -> tuple[int, int]:
    """The same for a folder that does not change. Raises ``DependencyError``."""
    for path in walk(folder):
        mode = path.lstat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise DependencyError(
                f"a package has {str(path.relative_to(folder))!r}, which is not a file",
                reason="integrity",
            )
    return measured(folder)


def walk(folder: Path) -> Iterator[Path]:
    """All that is below a folder, links not followed.

    Without recursion, as ``os.walk`` has it in older Pythons: a stranger chose how deep it is.
    """
    waiting = [str(folder)]
    while waiting:
        with contextlib.suppress(OSError), os.scandir(waiting.pop()) as items:
            for item in items:
                if item.is_dir(follow_symlinks=False):
                    waiting.append(item.path)
                yield Path(item.path)

"""Bounds the size of an environment and the free space that it must leave on the disk.

A small file on an index may unpack to fill a disk. So this module watches uv: the downloads that it
announces, the size of the folder, and the free space of the disks that it writes to. The kernel
ends uv if a single file exceeds the bound.
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
"""Bytes of a disk that an installation leaves to other programs."""
_ANNOUNCED = re.compile(r"Downloading (\S{1,200}) \((\d{1,9}(?:\.\d{1,9})?)([KMGT]iB)\)")
_UNITS = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}


@dataclass(frozen=True)
class Bounds:
    """Limits of one environment: bytes (before bytecode is made), and files including folders."""

    bytes: int
    files: int

    @classmethod
    def set(cls) -> Bounds:
        """Reads the user's limits; ``DependencyError`` if a variable holds no number."""
        return cls(_number(BYTES_VARIABLE, MAX_BYTES), _number(FILES_VARIABLE, MAX_FILES))

    def check(self, size: int, files: int, subject: str) -> None:
        """Raise ``DependencyError`` if the size or the number of files exceeds its limit."""
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
    """Watches an installation in progress: its folder, and the disks that uv writes to."""

    def __init__(self, bounds: Bounds, folder: Path, places: Sequence[Path]) -> None:
        self.bounds = bounds
        self._folder = folder
        self._places = [
            next(path for path in (place, *place.parents) if path.exists())
            for place in (folder, *places)
        ]
        self._announced = 0

    def hear(self, line: str) -> None:
        """Count the downloads that uv announces: a package grows when it is unpacked."""
        if match := _ANNOUNCED.fullmatch(line):
            self._announced += int(float(match[2]) * _UNITS[match[3]])

    def look(self) -> None:
        """Raise ``DependencyError`` if a limit is exceeded or a disk is almost full."""
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
    """Returns bytes and number of all entries below a folder; vanished entries count nothing."""
    size = count = 0
    for path in walk(folder):
        try:
            size += path.lstat().st_size
            count += 1
        except FileNotFoundError:
            continue
    return size, count


def checked(folder: Path) -> tuple[int, int]:
    """Measures a folder that does not change. Raises ``DependencyError`` for special files."""
    for path in walk(folder):
        mode = path.lstat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise DependencyError(
                f"a package has {str(path.relative_to(folder))!r}, which is not a file",
                reason="integrity",
            )
    return measured(folder)


def walk(folder: Path) -> Iterator[Path]:
    """Yields all paths below a folder; follows no links.

    Without recursion, unlike ``os.walk`` of older Pythons: a stranger chose the depth.
    """
    waiting = [str(folder)]
    while waiting:
        with contextlib.suppress(OSError), os.scandir(waiting.pop()) as items:
            for item in items:
                if item.is_dir(follow_symlinks=False):
                    waiting.append(item.path)
                yield Path(item.path)

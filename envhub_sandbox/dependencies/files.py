"""Which files may say what a repository needs: asked of every repository, so it imports nothing."""

from __future__ import annotations

from pathlib import Path

REQUIREMENTS = "requirements.txt"
PROJECT = "pyproject.toml"
SCRIPT = "# /// script"
LOOKED_AT = 1024 * 1024
"""Bytes at the beginning of an entry file in which metadata is looked for."""


def requirements_file(root: Path, entry: str) -> str | None:
    """The ``requirements.txt`` that counts: beside the entry file, or else at the root."""
    beside = entry.rpartition("/")[0]
    names = dict.fromkeys((f"{beside}/{REQUIREMENTS}".lstrip("/"), REQUIREMENTS))
    return next((name for name in names if (root / name).is_file()), None)


def may_declare(root: Path, entry: str) -> bool:
    """Whether it is worth reading them."""
    if requirements_file(root, entry) or (root / PROJECT).is_file():
        return True
    with (root / entry).open("rb") as file:
        return SCRIPT.encode() in file.read(LOOKED_AT)

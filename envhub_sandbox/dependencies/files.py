"""Which files may say what a repository needs: asked of every repository, so it imports nothing."""

from __future__ import annotations

from pathlib import Path

REQUIREMENTS = "requirements.txt"
PROJECT = "pyproject.toml"
SCRIPT = "# /// script"
LOOKED_AT = 1024 * 1024
"""Bytes at the beginning of an entry file in which metadata is looked for."""


def may_declare(root: Path, entry: str) -> bool:
    """Whether it is worth reading them."""
    if any((root / name).is_file() for name in (REQUIREMENTS, PROJECT)):
        return True
    with (root / entry).open("rb") as file:
        return SCRIPT.encode() in file.read(LOOKED_AT)

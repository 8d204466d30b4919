"""How sources say that they are built, read as data (PEP 517, PEP 518)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envhub_sandbox.dependencies.declared import MAX_BYTES, WantedPackage, parse_requirement
from envhub_sandbox.errors import RequirementError
from envhub_sandbox.hub.sources import toml

_LEGACY = ("setuptools", "wheel")
_LEGACY_BACKEND = "setuptools.build_meta:__legacy__"
_MOST = 200


@dataclass(frozen=True)
class Project:
    """What it is built with: packages, the backend (``module:object``), and folders of the sources
    that the backend is looked for in first.
    """

    requires: tuple[WantedPackage, ...]
    backend: str
    backend_path: tuple[str, ...] = ()

    @property
    def uses_setuptools(self) -> bool:
        """Whether setuptools builds it."""
        return self.backend.startswith("setuptools.")


def read(tree: Path, title: str) -> Project:
    """What the sources say; where they say nothing, setuptools builds them."""
    where = f"[build-system] of {title}"
    table = _table(tree / "pyproject.toml", where)
    requires = _texts(table.get("requires", list(_LEGACY)), where)
    backend = table.get("build-backend", _LEGACY_BACKEND)
    paths = _texts(table.get("backend-path", []), where)
    if not isinstance(backend, str) or not all(
        map(str.isidentifier, backend.replace(":", ".", 1).split("."))
    ):
        raise RequirementError(f"{where}: {str(backend)[:200]!r} is not a build backend")
    return Project(tuple(parse_requirement(text, where) for text in requires), backend, paths)


def _table(path: Path, where: str) -> dict[str, Any]:
    if not path.is_file():
        return {}
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    try:
        if len(data) > MAX_BYTES:
            raise ValueError("it is too long")
        table = toml.loads(data.decode("utf-8-sig"), MAX_BYTES).get("build-system", {})
    except ValueError as error:
        raise RequirementError(f"{where} cannot be read: {str(error)[:200]}") from error
    if not isinstance(table, dict):
        raise RequirementError(f"{where} is no table")
    return table


def _texts(found: object, where: str) -> tuple[str, ...]:
    if not isinstance(found, list) or len(found) > _MOST:
        raise RequirementError(f"{where} has no list of at most {_MOST} texts")
    if not all(isinstance(item, str) and item.isprintable() for item in found):
        raise RequirementError(f"{where} holds something else than texts")
    return tuple(found)

"""The packages and repositories that are tried, as data: ``packages.toml`` and ``repositories``."""

from __future__ import annotations

import hashlib
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

HERE = Path(__file__).resolve().parent
REPOSITORIES = HERE / "repositories"
_ENV = """\
import os
os.environ.setdefault("MUJOCO_GL", {gl!r})
import {gym} as gym
{imports}

def make_env(n_envs=1, use_async_envs=False):
    return {make}
"""
_MADE = "gym.vector.SyncVectorEnv([lambda: gym.make({id!r}, **{kwargs!r})] * n_envs)"


@dataclass(frozen=True)
class Case:
    """A repository.

    Attributes:
        name: What it is called in the table.
        kind: ``"package"`` or ``"repository"``.
        about: What is particular about it.
        argument: The one further argument that helps, as ``make_env`` takes it.
        python: Of the control, where our run has chosen none: a release as ``"3.10"``.
        control: What the control installs where our run has installed nothing; empty for
            ``requirements.txt``.
        entry: Its entry file.
        path: Folders of it that the control finds modules in, beside its root.
        quick: Whether it is one of those that CI tries.
        files: Its files by path.
    """

    name: str
    kind: str
    about: str = ""
    argument: Mapping[str, Any] = field(default_factory=dict)
    python: str = ""
    control: tuple[str, ...] = ()
    entry: str = "env.py"
    path: tuple[str, ...] = ()
    quick: bool = False
    files: Mapping[str, bytes] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Its files, readable by the other user that a jail of root is."""
        for path, content in self.files.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)

    @property
    def digest(self) -> str:
        """Of all that decides what comes of it."""
        facts = [self.name, self.argument, self.python, self.control, sorted(self.files.items())]
        return hashlib.sha256(repr(facts).encode()).hexdigest()[:16]


def cases() -> dict[str, Case]:
    """All of them by name, packages first."""
    about = tomllib.loads((HERE / "packages.toml").read_text())
    packages = {name: _package(name, fields) for name, fields in about.items()}
    return packages | {path.name: _repository(path) for path in sorted(REPOSITORIES.iterdir())}


def _package(name: str, fields: dict[str, Any]) -> Case:
    own = dict(fields)
    made = {"id": own.pop("id", ""), "kwargs": own.pop("kwargs", {})}
    code = _ENV.format(
        gl=own.pop("gl", "disable"),
        gym=own.pop("gym", "gymnasium"),
        imports="\n".join(own.pop("imports", ())),
        make=own.pop("make", _MADE.format(**made)),
    )
    required = "".join(f"{line}\n" for line in own.pop("requirements", [name]))
    files = {"env.py": code.encode(), "requirements.txt": required.encode()}
    return Case(name, "package", files=files, **_tuples(own))


def _repository(folder: Path) -> Case:
    about = tomllib.loads((folder / "case.toml").read_text())
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    files = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in paths
        if path.name != "case.toml" and "__pycache__" not in path.parts
    }
    if walk := about.pop("walk", None):  # the environment of most is the same
        files[walk] = (HERE / "walk.py").read_bytes()
    return Case(folder.name, "repository", files=files, **_tuples(about))


def _tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(one) if isinstance(one, list) else one for key, one in fields.items()}


def removed(folder: Path) -> None:
    """Remove a folder, read-only parts included."""
    for path in [folder, *folder.rglob("*")]:
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o755)
    shutil.rmtree(folder)

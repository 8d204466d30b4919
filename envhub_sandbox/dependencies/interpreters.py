"""Interpreters of this machine that a repository can run in.

None is downloaded unless the caller permits it (``fetch_python``); then uv does.

A repository's packages lie in a folder of their own, so what is wanted is an interpreter and
nothing of its packages: the one that a virtual environment was made of, and not the environment.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from packaging.specifiers import InvalidSpecifier, SpecifierSet
from packaging.version import InvalidVersion, Version

from envhub_sandbox.dependencies import uv
from envhub_sandbox.errors import DependencyError, InterpreterUnavailableError
from envhub_sandbox.settings.options import option_name

_ASK_S = 60.0
_FIND_S = 120.0
_FETCH_S = 600.0
_OLDEST = SpecifierSet(">=3.10")
_ASK = (
    "import json, os, platform, sys; print(json.dumps([sys.implementation.name,"
    " platform.python_version(), os.uname().machine, platform.libc_ver()[1],"
    " os.path.realpath(sys.executable)]))"
)


@dataclass(frozen=True)
class Interpreter:
    """An interpreter, without its packages.

    Attributes:
        path: Absolute, and no link.
        version: ``"3.11.2"``.
        libc: glibc's version.
    """

    path: str
    implementation: str
    version: str
    machine: str
    libc: str

    @property
    def series(self) -> str:
        """Which wheels it takes: ``"cpython 3.11"``."""
        return f"{self.implementation} {'.'.join(self.version.split('.')[:2])}"

    def fits(self, versions: SpecifierSet) -> bool:
        """Whether it is among these versions."""
        return versions.contains(self.version, prereleases=True)


def own() -> Interpreter:
    """The one that this process runs in; what it was made of, if it is a virtual environment."""
    name = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    base = os.path.realpath(os.path.join(sys.base_prefix, "bin", name))
    if not os.access(base, os.X_OK):
        base = os.path.realpath(sys.executable)
    return Interpreter(
        base,
        sys.implementation.name,
        release(platform.python_version()),
        platform.machine(),
        platform.libc_ver()[1],
    )


def release(version: str) -> str:
    """A version of Python as one that can be compared: built from a checkout it ends in a plus."""
    return version.rstrip("+")


def find(asked: str, declared: str = "", *, fetch: bool = False) -> Interpreter:
    """An interpreter that fits: this one if it does, else the newest that is at hand.

    Args:
        asked: The caller's choice: a version (``"3.11"``), versions (``">=3.11,<3.13"``) or a path;
            empty for none.
        declared: The versions that the repository runs in.
        fetch: Whether uv may download one where none is at hand.
    """
    if os.sep in asked:
        return _at(os.path.abspath(os.path.expanduser(asked)))
    wanted = versions(asked) & SpecifierSet(declared) & _OLDEST
    ours = own()
    if ours.fits(wanted):
        return ours
    found = _others(wanted)
    if not found and fetch:
        _fetch(wanted)
        found = _others(wanted)
    if found:
        return found[0]
    why = f"you ask for Python {asked!r}" if asked else f"it runs in Python {declared}"
    named = option_name("dependencies", {"python": "/path/to/python3"})
    fetched = option_name("dependencies", {"python": asked or "3.12", "fetch_python": True})
    raise InterpreterUnavailableError(
        f"{why}, and this machine has no such interpreter of 3.10 or later; this one is "
        f"{ours.version} ({ours.path}). Install one ('uv python install'), let uv download it with "
        f"{fetched}, or name one: {named}"
    )


def others(declared: str, first: Interpreter) -> list[Interpreter]:
    """The other releases on this machine that a repository may run in, the newest first."""
    found = _others(SpecifierSet(declared) & _OLDEST)
    return [one for one in found if one.series != first.series]


def _fetch(wanted: SpecifierSet) -> None:
    uv.run(
        ["python", "install", "--no-config", str(wanted)],
        what=f"no interpreter for Python {wanted} could be downloaded",
        timeout_s=_FETCH_S,
        variables={"UV_PYTHON_DOWNLOADS": "manual"},
    )


def check_versions(asked: str) -> None:
    """Refuse what is neither a version, nor versions, nor a path. Raises ``ValueError``."""
    if os.sep not in asked:
        versions(asked)


def versions(asked: str) -> SpecifierSet:
    """What a caller asks for: one version, or several; otherwise ``ValueError``."""
    try:
        return SpecifierSet(f"=={Version(asked)}.*" if asked.count(".") < 2 else f"=={asked}")
    except (InvalidVersion, InvalidSpecifier):
        return SpecifierSet(asked)


def _at(path: str) -> Interpreter:
    try:
        done = subprocess.run(
            [path, "-I", "-S", "-c", _ASK], capture_output=True, timeout=_ASK_S, check=True
        )
        implementation, version, *facts, real = map(str, json.loads(done.stdout))
        Version(release(version))
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise InterpreterUnavailableError(
            f"{path} does not work as an interpreter: {error}"
        ) from error
    return Interpreter(real, implementation, release(version), *facts)


def _others(wanted: SpecifierSet) -> list[Interpreter]:
    """What uv finds, and what pyenv keeps where uv does not look; one of each series."""
    paths = [*_pyenvs()]
    try:
        found = uv.run(
            ["python", "list", "--no-config", "--only-installed", "--output-format", "json"],
            what="no interpreter was found",
            timeout_s=_FIND_S,
        )
        paths += [str(row["path"]) for row in json.loads(found) if _may_be(row)]
    except (DependencyError, ValueError, LookupError, TypeError):
        pass  # there is none that uv finds
    newest: dict[str, Interpreter] = {}
    for one in sorted(_answering(paths), key=lambda one: Version(one.version), reverse=True):
        if one.fits(wanted):
            newest.setdefault(one.series, one)
    return list(newest.values())


def _answering(paths: Iterable[str]) -> Iterator[Interpreter]:
    for path in dict.fromkeys(map(os.path.realpath, paths)):
        with contextlib.suppress(InterpreterUnavailableError):
            yield _at(path)


def _may_be(row: dict[str, object]) -> bool:
    """Whether it is worth asking: pyenv's shims are no interpreters, and 3.14t is another ABI."""
    default = row.get("variant", "default") == "default"
    return default and row.get("implementation") == "cpython" and "/shims/" not in str(row["path"])


def _pyenvs() -> list[str]:
    root = os.environ.get("PYENV_ROOT") or os.path.expanduser("~/.pyenv")
    # which may be another user's; this glob finds nothing where it may not look
    return glob.glob(f"{glob.escape(root)}/versions/3.*/bin/python3")

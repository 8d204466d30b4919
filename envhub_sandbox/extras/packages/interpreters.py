"""Interpreters that a repository can run in, and whether what is installed there is enough.

None is downloaded unless the caller permits it (``fetch_python``); then uv does. Nothing is
imported: what is installed says its metadata.

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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import NamedTuple

from packaging.markers import default_environment
from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages.declared import versions
from envhub_sandbox.extras.packages.request import PackageRequest
from envhub_sandbox.extras.packages.resolution import uv
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
    """An interpreter, without its packages, by its absolute path, which is no link."""

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


def find(python: str, declared: str = "", *, fetch: bool = False) -> Interpreter:
    """An interpreter that fits: this one if it does, else the newest that is at hand.

    The caller may ask for a version (``"3.11"``), versions (``">=3.11,<3.13"``) or a path; the
    repository declares versions. Where none is at hand uv may ``fetch`` one.
    """
    if os.sep in python:
        return _at(os.path.abspath(os.path.expanduser(python)))
    wanted = versions(python) & SpecifierSet(declared) & _OLDEST
    ours = own()
    if ours.fits(wanted):
        return ours
    interpreters = _others(wanted)
    if not interpreters and fetch:
        _fetch(wanted)
        interpreters = _others(wanted)
    if interpreters:
        return interpreters[0]
    why = f"you ask for Python {python!r}" if python else f"it runs in Python {declared}"
    named = option_name("dependencies", {"python": "/path/to/python3"})
    fetched = option_name("dependencies", {"python": python or "3.12", "fetch_python": True})
    raise DependencyError(
        f"{why}, and this machine has no such interpreter of 3.10 or later; this one is "
        f"{ours.version} ({ours.path}). Install one ('uv python install'), let uv download it with "
        f"{fetched}, or name one: {named}",
        reason="interpreter",
    )


def others(declared: str, first: Interpreter) -> list[Interpreter]:
    """The other releases on this machine that a repository may run in, the newest first."""
    interpreters = _others(SpecifierSet(declared) & _OLDEST)
    return [version for version in interpreters if version.series != first.series]


def _fetch(wanted: SpecifierSet) -> None:
    uv.run(
        ["python", "install", "--no-config", str(wanted)],
        what=f"no interpreter for Python {wanted} could be downloaded",
        timeout_s=_FETCH_S,
        variables={"UV_PYTHON_DOWNLOADS": "manual"},
    )


def _at(path: str) -> Interpreter:
    try:
        done = subprocess.run(
            [path, "-I", "-S", "-c", _ASK], capture_output=True, timeout=_ASK_S, check=True
        )
        implementation, version, *facts, real = map(str, json.loads(done.stdout))
        Version(release(version))
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise DependencyError(
            f"{path} does not work as an interpreter: {error}", reason="interpreter"
        ) from error
    return Interpreter(real, implementation, release(version), *facts)


def _others(wanted: SpecifierSet) -> list[Interpreter]:
    """What uv finds, and what pyenv keeps where uv does not look; one of each series."""
    root = os.environ.get("PYENV_ROOT") or os.path.expanduser("~/.pyenv")
    # which may be another user's; this glob finds nothing where it may not look
    paths = glob.glob(f"{glob.escape(root)}/versions/3.*/bin/python3")
    # its shims are no interpreters, but uv would start every one, each time
    searched = os.environ.get("PATH", os.defpath).split(os.pathsep)
    search = os.pathsep.join(path for path in searched if os.path.basename(path) != "shims")
    try:
        answer = uv.run(
            ["python", "list", "--no-config", "--only-installed", "--output-format", "json"],
            what="no interpreter was found",
            timeout_s=_FIND_S,
            variables={"PATH": search},
        )
        paths += [str(row["path"]) for row in json.loads(answer) if _may_be(row)]
    except (DependencyError, ValueError, LookupError, TypeError):
        pass  # there is none that uv finds
    newest: dict[str, Interpreter] = {}
    for one in sorted(_answering(paths), key=lambda one: Version(one.version), reverse=True):
        if one.fits(wanted):
            newest.setdefault(one.series, one)
    return list(newest.values())


def _answering(paths: Iterable[str]) -> Iterator[Interpreter]:
    for path in dict.fromkeys(map(os.path.realpath, paths)):
        with contextlib.suppress(DependencyError):
            yield _at(path)


def _may_be(row: dict[str, object]) -> bool:
    """Whether it is worth asking: 3.14t is another ABI."""
    return (row.get("variant", "default"), row.get("implementation")) == ("default", "cpython")


class InstalledPackage(NamedTuple):
    """A distribution of an interpreter elsewhere: its version, and what it needs."""

    version: str
    requires: Sequence[str]


def first_unmet(
    request: PackageRequest,
    there: Mapping[str, InstalledPackage] | None = None,
    version: str | None = None,
) -> str | None:
    """The first requirement that an interpreter does not meet, of those asked for or of theirs.

    None if it meets them all. Where hashes or a repository are given it never does: the metadata
    does not say what its packages were made of. The interpreter is this one, unless another's
    packages (``there``) and version are given.
    """
    python = SpecifierSet(request.supports)
    python_version = version or release(platform.python_version())
    if not python.contains(python_version, prereleases=True):
        return f"python{request.supports}"
    hashed = next(
        (package for package in request.wanted if package.hashes or package.requirement.url), None
    )
    if hashed is not None:
        return str(hashed.requirement)
    reached = _reached((package.requirement for package in request.wanted), there, python_version)
    for wanted, met_by in reached:
        if met_by is None or not _is_among(met_by, wanted.specifier):
            return str(wanted)
    return None


def brought(requirements: Iterable[Requirement]) -> list[metadata.Distribution]:
    """What this interpreter has of these, whichever version, and of all that they lead to."""
    return [
        distribution
        for _, distribution in _reached(requirements)
        if isinstance(distribution, metadata.Distribution)
    ]


def _reached(
    requirements: Iterable[Requirement],
    there: Mapping[str, InstalledPackage] | None = None,
    version: str = "",
) -> Iterator[tuple[Requirement, metadata.Distribution | InstalledPackage | None]]:
    """Each that applies, of all that they lead to, and what is installed of that name: here, or
    ``there``, where Python is of that version.
    """
    environment = {str(k): str(v) for k, v in default_environment().items()}
    if there is not None:
        there = {canonicalize_name(name): one for name, one in there.items()}
        minor = ".".join(version.split(".")[:2])
        environment |= {"python_full_version": version, "python_version": minor}
    here = cache(_distribution)
    met: set[tuple[str, frozenset[str]]] = set()
    waiting = [(requirement, frozenset[str]()) for requirement in requirements]
    while waiting:
        wanted, extras = waiting.pop()
        try:
            if not _applies(wanted, extras, environment):
                continue
        except (ValueError, LookupError):  # its marker cannot be evaluated, as uv will say
            yield wanted, None
            continue
        key = (canonicalize_name(wanted.name), frozenset(wanted.extras))
        found = here(wanted.name) if there is None else there.get(key[0])
        yield wanted, found
        if found is not None and key not in met:
            met.add(key)
            waiting += [(requirement, key[1]) for requirement in _needs(found)]


def _applies(wanted: Requirement, extras: frozenset[str], environment: dict[str, str]) -> bool:
    marker = wanted.marker
    each = ({**environment, "extra": extra} for extra in extras or ("",))
    return marker is None or any(marker.evaluate(variables) for variables in each)


def _distribution(name: str) -> metadata.Distribution | None:
    try:
        return metadata.distribution(name)
    except (metadata.PackageNotFoundError, ValueError):
        return None


def installed_from(name: str) -> str:
    """The folder that a distribution of this interpreter was installed from; empty for none."""
    found = _distribution(name)
    with contextlib.suppress(ValueError, LookupError, TypeError):
        facts = json.loads((found.read_text("direct_url.json") if found else None) or "{}")
        return str(facts["url"]) if isinstance(facts["dir_info"], dict) else ""
    return ""


def _is_among(found: metadata.Distribution | InstalledPackage, versions: SpecifierSet) -> bool:
    try:
        return versions.contains(found.version, prereleases=True)
    except (InvalidVersion, TypeError):
        return False


def _needs(found: metadata.Distribution | InstalledPackage) -> list[Requirement]:
    try:
        return [Requirement(text) for text in found.requires or ()]
    except InvalidRequirement:
        return []  # of old metadata; what is installed already works for its owner

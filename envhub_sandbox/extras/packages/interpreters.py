"""Finds interpreters that a repository can run in, and checks their installed packages.

uv downloads an interpreter only if the caller permits it (``fetch_python``). This module imports no
package: it reads the metadata of installed ones.

A repository's packages lie in their own folder, so it needs an interpreter without packages: the
base interpreter of a virtual environment, not the environment.
"""

from __future__ import annotations

import contextlib
import glob
import itertools
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
    """An interpreter without its packages, by its absolute path, links resolved."""

    path: str
    implementation: str
    version: str
    machine: str
    libc: str

    @property
    def series(self) -> str:
        """Returns the kind of wheels that it takes: ``"cpython 3.11"``."""
        return f"{self.implementation} {'.'.join(self.version.split('.')[:2])}"

    def fits(self, versions: SpecifierSet) -> bool:
        """Tells whether its version is among these versions."""
        return versions.contains(self.version, prereleases=True)


def own() -> Interpreter:
    """Returns this process's interpreter, or the base interpreter of its virtual environment."""
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
    """Makes a version of Python comparable: a build from a checkout ends in a plus."""
    return version.rstrip("+")


def find(python: str, declared: str = "", *, fetch: bool = False) -> Interpreter:
    """Returns a fitting interpreter: this process's if it fits, else the newest on this machine.

    The caller may name a version (``"3.11"``), versions (``">=3.11,<3.13"``) or a path; the
    repository declares versions. If none fits, uv may ``fetch`` an interpreter.
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
    asked = [f"you ask for Python {python!r}"] if python else []
    why = " and ".join([*asked, *([f"it runs in Python {declared}"] if declared else [])])
    named = option_name("dependencies", {"python": "/path/to/python3"})
    releases = itertools.product(range(10, 100), range(30))
    if not any(wanted.contains(f"3.{minor}.{patch}") for minor, patch in releases):
        raise DependencyError(
            f"{why}; with jails in 3.10 or later, no release fits. To try another one all the "
            f"same, name its path: {named}",
            reason="interpreter",
        )
    fetched = option_name("dependencies", {"python": python or declared, "fetch_python": True})
    raise DependencyError(
        f"{why}, and this machine has no such interpreter of 3.10 or later; this one is "
        f"{ours.version} ({ours.path}). Install one ('uv python install'), let uv download it with "
        f"{fetched}, or name one: {named}",
        reason="interpreter",
    )


def others(declared: str, first: Interpreter) -> list[Interpreter]:
    """Returns the other fitting Python releases on this machine, the newest first."""
    interpreters = _others(SpecifierSet(declared) & _OLDEST)
    return [other for other in interpreters if other.series != first.series]


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
    """Returns one interpreter of each series, from uv and from pyenv's folder."""
    root = os.environ.get("PYENV_ROOT") or os.path.expanduser("~/.pyenv")
    # the folder may be another user's; glob yields nothing for an unreadable folder
    paths = glob.glob(f"{glob.escape(root)}/versions/3.*/bin/python3")
    # pyenv's shims are no interpreters, but uv would start each of them every time
    searched = map(os.path.normpath, os.environ.get("PATH", os.defpath).split(os.pathsep))
    search = os.pathsep.join(path for path in searched if os.path.basename(path) != "shims")
    try:
        answer = uv.run(
            ["python", "list", "--no-config", "--only-installed", "--output-format", "json"],
            what="no interpreter was found",
            timeout_s=_FIND_S,
            variables={"PATH": search},
        )
        kind = ("default", "cpython")  # a variant, such as 3.14t, has another ABI
        paths += [
            str(row["path"])
            for row in json.loads(answer)
            if (row.get("variant", "default"), row.get("implementation")) == kind
        ]
    except (DependencyError, ValueError, LookupError, TypeError):
        pass  # uv finds no interpreter
    newest: dict[str, Interpreter] = {}
    for one in sorted(_answering(paths), key=lambda one: Version(one.version), reverse=True):
        if one.fits(wanted):
            newest.setdefault(one.series, one)
    return list(newest.values())


def _answering(paths: Iterable[str]) -> Iterator[Interpreter]:
    for path in dict.fromkeys(map(os.path.realpath, paths)):
        with contextlib.suppress(DependencyError):
            yield _at(path)


class InstalledPackage(NamedTuple):
    """A distribution of another interpreter: its version and its requirements."""

    version: str
    requires: Sequence[str]


def first_unmet(
    request: PackageRequest,
    there: Mapping[str, InstalledPackage] | None = None,
    version: str | None = None,
) -> str | None:
    """Returns the first unmet requirement, of the request or of a package that it leads to.

    None if all are met. A request with hashes or a git repository is never met: the metadata does
    not record the origin of packages. The interpreter is this process's, unless the packages
    (``there``) and the version of another are given.
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
    """Returns this interpreter's distributions, of any version, that requirements lead to."""
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
    """Yields each applicable requirement, also of further packages, and the distribution installed
    for it: here, or in ``there`` with that version of Python.
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
            marker = wanted.marker
            each = ({**environment, "extra": extra} for extra in extras or ("",))
            if not (marker is None or any(marker.evaluate(variables) for variables in each)):
                continue
        except (ValueError, LookupError):  # uv will report the marker
            yield wanted, None
            continue
        key = (canonicalize_name(wanted.name), frozenset(wanted.extras))
        found = here(wanted.name) if there is None else there.get(key[0])
        yield wanted, found
        if found is not None and key not in met:
            met.add(key)
            waiting += [(requirement, key[1]) for requirement in _needs(found)]


def _distribution(name: str) -> metadata.Distribution | None:
    try:
        return metadata.distribution(name)
    except (metadata.PackageNotFoundError, ValueError):
        return None


def installed_from(name: str) -> str:
    """Returns the folder that a distribution here was installed from; empty if from none."""
    dist = _distribution(name)
    with contextlib.suppress(ValueError, LookupError, TypeError):
        facts = json.loads((dist.read_text("direct_url.json") if dist else None) or "{}")
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
        return []  # old metadata; the installed package already works for its owner

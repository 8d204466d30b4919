"""What is installed in an interpreter, by its metadata, and whether that is all that is declared.

Nothing is imported.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import metadata
from typing import NamedTuple

from packaging.markers import default_environment
from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion

from envhub_sandbox.dependencies.interpreters import release
from envhub_sandbox.dependencies.request import PackageRequest


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
    found = version or release(platform.python_version())
    if not python.contains(found, prereleases=True):
        return f"python{request.supports}"
    hashed = next((one for one in request.wanted if one.hashes or one.requirement.url), None)
    if hashed is not None:
        return str(hashed.requirement)
    there_or_here = _InstalledPackages() if there is None else _InstalledPackages(there, found)
    for wanted, met_by in there_or_here.reached(one.requirement for one in request.wanted):
        if met_by is None or not _is_among(met_by, wanted.specifier):
            return str(wanted)
    return None


def brought(requirements: Iterable[Requirement]) -> list[metadata.Distribution]:
    """What this interpreter has of these, whichever version, and of all that they lead to."""
    found = (one for _, one in _InstalledPackages().reached(requirements))
    return [one for one in found if isinstance(one, metadata.Distribution)]


class _InstalledPackages:
    """What an interpreter has: this one, or one elsewhere of that version."""

    def __init__(
        self, elsewhere: Mapping[str, InstalledPackage] | None = None, version: str = ""
    ) -> None:
        self._met: set[tuple[str, frozenset[str]]] = set()
        self._is_here = elsewhere is None
        self._found: dict[str, metadata.Distribution | InstalledPackage | None] = {
            canonicalize_name(name): one for name, one in (elsewhere or {}).items()
        }
        self._environment = {str(k): str(v) for k, v in default_environment().items()}
        if version:
            minor = ".".join(version.split(".")[:2])
            self._environment |= {"python_full_version": version, "python_version": minor}

    def reached(
        self, requirements: Iterable[Requirement]
    ) -> Iterator[tuple[Requirement, metadata.Distribution | InstalledPackage | None]]:
        """Each that applies here, of all that they lead to, and what is here of that name."""
        waiting = [(one, frozenset[str]()) for one in requirements]
        while waiting:
            wanted, extras = waiting.pop()
            try:
                if not self._applies(wanted, extras):
                    continue
            except (
                ValueError,
                LookupError,
            ):  # its marker cannot be evaluated, as uv will say
                yield wanted, None
                continue
            found = self._distribution(wanted.name)
            yield wanted, found
            key = (canonicalize_name(wanted.name), frozenset(wanted.extras))
            if found is not None and key not in self._met:
                self._met.add(key)
                waiting += [(one, key[1]) for one in _needs(found)]

    def _applies(self, wanted: Requirement, extras: frozenset[str]) -> bool:
        if wanted.marker is None:
            return True
        each = ({**self._environment, "extra": extra} for extra in extras or ("",))
        return any(wanted.marker.evaluate(environment) for environment in each)

    def _distribution(self, name: str) -> metadata.Distribution | InstalledPackage | None:
        key = canonicalize_name(name)
        if self._is_here and key not in self._found:
            try:
                self._found[key] = metadata.distribution(name)
            except (metadata.PackageNotFoundError, ValueError):
                self._found[key] = None
        return self._found.get(key)


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

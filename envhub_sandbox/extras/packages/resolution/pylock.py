"""Packages with their files: read from uv's answers and from lock files, and written to the latter.

Both have the form of https://peps.python.org/pep-0751/, which is read as data, checked, and printed
anew. uv never receives the text of a lock file, only names, versions and hashes that match our
patterns.

A package without a wheel on the index is locked by its source, which is fetched and hashed again.
The hash of the built wheel tells whether the next build gives the same bytes; the compilers of two
machines give different ones.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, TypeGuard

from packaging.requirements import InvalidRequirement, Requirement
from packaging.version import InvalidVersion, Version

from envhub_sandbox.errors import LockError
from envhub_sandbox.extras.packages.declared import Source, WheelOrigin, of_git
from envhub_sandbox.extras.sources import toml
from envhub_sandbox.extras.sources.toml import table
from envhub_sandbox.hub.logins import without_login

MAX_CHARACTERS = 16 * 1024 * 1024
MAX_PACKAGES = 2000
MAX_WHEELS = 200
"""Wheels of one package: one for each platform and interpreter."""
_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_VERSION = re.compile(r"[A-Za-z0-9.!+_-]{1,200}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_COMMIT = re.compile(r"[0-9a-f]{40}")
_URL = re.compile(r"(?:https?|file)://[^\s\"\\]{1,2000}")


@dataclass(frozen=True)
class Wheel:
    """A file of a package. ``url`` informs readers of the lock: the user's settings decide where
    the file comes from. The size may be unknown.
    """

    sha256: str
    url: str = ""
    size: int | None = None


@dataclass(frozen=True)
class PylockPackage:
    """A package at one version, with the files that may be installed for it."""

    name: str
    version: str
    wheels: tuple[Wheel, ...]
    origin: WheelOrigin | None = None
    """The origin of its wheel, if the index has no wheels."""

    @property
    def pin(self) -> str:
        """Returns the pin in the form of pip's ``--require-hashes``."""
        known = [self.origin.wheel] if self.origin else [wheel.sha256 for wheel in self.wheels]
        hashes = (f"    --hash=sha256:{digest}" for digest in known)
        return " \\\n".join([f"{self.name}=={self.version}", *hashes]) + "\n"


@dataclass(frozen=True)
class Lock:
    """All packages, and options for uv if the index lacks some of them."""

    pinned: tuple[PylockPackage, ...]
    options: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Returns the pins in the form of pip's ``--require-hashes``."""
        return "".join(package.pin for package in self.pinned)

    @property
    def digest(self) -> str:
        """Returns the hexadecimal SHA-256 of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def packages(self) -> list[str]:
        """Returns ``name==version`` of each package."""
        return [f"{package.name}=={package.version}" for package in self.pinned]

    @property
    def has_cuda(self) -> bool:
        """Tells whether the packages include PyTorch and packages of NVIDIA's."""
        names = [package.name for package in self.pinned]
        return "torch" in names and any(name.startswith(("nvidia-", "cuda-")) for name in names)


def document(text: str, where: str) -> dict[str, Any]:
    """Parses the TOML of a lock file; ``LockError`` if it is invalid or too long."""
    try:
        return toml.loads(text, MAX_CHARACTERS, generated=True)
    except ValueError as error:
        raise LockError(f"{where} is not valid TOML: {error}") from error


def read(document: Mapping[str, Any], where: str) -> tuple[PylockPackage, ...]:
    """Returns the packages in a lock file, sorted by name. Raises ``LockError``."""
    if document.get("lock-version") != "1.0":
        raise LockError(f"{where} is not a lock file of version 1.0")
    given = document.get("packages")
    if not isinstance(given, list) or len(given) > MAX_PACKAGES:
        raise LockError(f"packages in {where} is not a list of at most {MAX_PACKAGES}")
    packages = [_package(row, where) for row in given]
    names = [package.name for package in packages]
    if len(set(names)) != len(names):
        raise LockError(f"{where} names a package twice; a lock of envhub is for one interpreter")
    return tuple(sorted(packages, key=attrgetter("name")))


def _package(given: object, where: str) -> PylockPackage:
    if not isinstance(given, dict):
        raise LockError(f"a package in {where} is not a table")
    name, version = given.get("name"), given.get("version")
    if not _is(name, _NAME):
        raise LockError(f"{str(name)[:80]!r} in {where} is not a normalized name of a package")
    try:
        if not _is(version, _VERSION):
            raise InvalidVersion("no text")
        Version(version)
    except InvalidVersion as error:
        raise LockError(f"{name} in {where} has no version: {str(version)[:80]!r}") from error
    if origin := _origin(given, name, version, where):
        return PylockPackage(name, version, (), origin)
    if others := sorted({"vcs", "directory", "archive", "marker"} & given.keys()):
        raise LockError(
            f"{name} in {where} has {', '.join(others)}; only wheels of an index are installed"
        )
    wheels = given.get("wheels")
    if not isinstance(wheels, list) or not 1 <= len(wheels) <= MAX_WHEELS:
        raise LockError(f"{name} in {where} has no list of 1 to {MAX_WHEELS} wheels")
    return PylockPackage(
        name, version, tuple(_wheel(wheel, f"{name} in {where}") for wheel in wheels)
    )


def _wheel(given: object, where: str) -> Wheel:
    sha256 = table(given, "hashes").get("sha256")
    if not isinstance(given, dict) or not _is(sha256, _SHA256):
        raise LockError(f"a wheel of {where} has no SHA-256")
    url, size = given.get("url", ""), given.get("size")
    if type(size) is not int or size < 0:
        size = None
    return Wheel(sha256, without_login(url) if isinstance(url, str) else "", size)


def _is(value: object, form: re.Pattern[str]) -> TypeGuard[str]:
    return isinstance(value, str) and form.fullmatch(value) is not None


def _origin(given: Mapping[str, Any], name: str, version: str, where: str) -> WheelOrigin | None:
    """Returns the origin of a package's wheel; None for a package with wheels on an index."""
    ours = table(given, "tool", "envhub")
    if not ours:
        return None
    wheel, environment = ours.get("wheel"), ours.get("environment")
    if not _is(wheel, _SHA256) or not _is(environment, _SHA256):
        raise LockError(f"{name} in {where} has no hashes of the built files")
    if vcs := table(given, "vcs"):
        below = f"#subdirectory={vcs['subdirectory']}" if vcs.get("subdirectory") else ""
        try:
            requirement = Requirement(
                f"{name} @ git+{vcs.get('url')}@{vcs.get('commit-id')}{below}"
            )
            found = of_git(requirement, where)
        except InvalidRequirement:
            found = None
        if found is None or not _COMMIT.fullmatch(found.commit):
            raise LockError(f"{name} in {where} has no full commit of a repository of git")
        return WheelOrigin(replace(found, name=name, version=version, where=""), environment, wheel)
    sdist = table(given, "sdist")
    url, digest = sdist.get("url"), table(sdist, "hashes").get("sha256")
    if not _is(url, _URL) or not _is(digest, _SHA256):
        raise LockError(f"{name} in {where} has no source with a URL and a SHA-256")
    return WheelOrigin(Source(name, version, url, digest), environment, wheel)


def written(packages: Sequence[PylockPackage]) -> str:
    """Returns the packages in the standard's form."""
    lines = []
    for package in packages:
        lines += ["", "[[packages]]", *rows({"name": package.name, "version": package.version})]
        if package.origin is not None:
            lines += rows(_of_origin(package.origin))
        else:
            wheels = (f"    {as_toml(_row(wheel))}," for wheel in package.wheels)
            lines += ["wheels = [", *wheels, "]"]
    return "\n".join([*lines, ""])


def _row(wheel: Wheel) -> dict[str, object]:
    size = {} if wheel.size is None else {"size": wheel.size}
    return {"url": wheel.url, **size, "hashes": {"sha256": wheel.sha256}}


def _of_origin(origin: WheelOrigin) -> dict[str, object]:
    source = origin.source
    ours = {"envhub": {"wheel": origin.wheel, "environment": origin.environment}}
    if not source.commit:
        sdist = {"url": source.url, "hashes": {"sha256": source.sha256}}
        return {"sdist": sdist, "tool": ours}
    below = {"subdirectory": source.subdirectory} if source.subdirectory else {}
    vcs = {"type": "git", "url": source.url, "commit-id": source.commit, **below}
    return {"vcs": vcs, "tool": ours}


def rows(table: Mapping[str, object]) -> list[str]:
    """Returns the lines of a TOML table."""
    return [f"{name} = {as_toml(value)}" for name, value in table.items()]


def as_toml(value: object) -> str:
    """Returns a value in one line. TOML accepts JSON strings except for one control character."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(rows(value))} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(as_toml, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")

"""The part of a lock file that is a standard, https://peps.python.org/pep-0751/, as data.

uv writes it for the pins, and what it wrote is read, checked and printed anew. Nothing of a lock
file is ever handed to uv as it stands: only names, versions and hashes of these forms get through.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from packaging.version import InvalidVersion, Version

from envhub_sandbox.dependencies import index, torch_cpu, uv
from envhub_sandbox.dependencies.resolve import Lock, Target
from envhub_sandbox.errors import LockError, PackageIntegrityError
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.locks import toml
from envhub_sandbox.locks.built import Origin, origins
from envhub_sandbox.locks.built import read as read_origin

MAX_PACKAGES = 2000
MAX_WHEELS = 200
"""Of one package: one for each platform and interpreter that it is built for."""
_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_VERSION = re.compile(r"[A-Za-z0-9.!+_-]{1,200}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_DESCRIBE_S = 600.0


@dataclass(frozen=True)
class Wheel:
    """One file of a package.

    Attributes:
        sha256: Hexadecimal.
        url: Where it was found, for the reader: the user's settings say where it is taken from.
        size: In bytes; None where the index does not say.
    """

    sha256: str
    url: str = ""
    size: int | None = None


@dataclass(frozen=True)
class Package:
    """A package at one version, with the files that it may be installed from."""

    name: str
    version: str
    wheels: tuple[Wheel, ...]
    origin: Origin | None = None
    """What it is built of, where it has no wheels."""

    @property
    def pin(self) -> str:
        """As pip's ``--require-hashes`` reads it."""
        known = [self.origin.wheel] if self.origin else [one.sha256 for one in self.wheels]
        hashes = (f"    --hash=sha256:{one}" for one in known)
        return " \\\n".join([f"{self.name}=={self.version}", *hashes]) + "\n"


def pins(packages: Sequence[Package]) -> Lock:
    """What is installed for them."""
    lock = Lock("".join(package.pin for package in packages))
    return replace(lock, options=torch_cpu.options_for(lock))


def described(lock: Lock, python: str) -> tuple[Package, ...]:
    """The pins with their files, as the index has them now, for the interpreter at this path.

    Raises:
        PackageIntegrityError: No file of a package is one that the pins permit.
        DependencyError: As with uv.
    """
    versions = [line.partition(" ")[0] for line in lock.text.splitlines()]
    found = listed(versions, python, lock.options)
    permitted = set(re.findall(r"--hash=sha256:([0-9a-f]{64})", lock.text))
    built = origins(lock)
    kept = []
    for package in found:
        origin = next((built[one.sha256] for one in package.wheels if one.sha256 in built), None)
        if origin is not None:
            kept.append(Package(package.name, package.version, (), origin))
            continue
        wheels = tuple(wheel for wheel in package.wheels if wheel.sha256 in permitted)
        if not wheels:
            raise PackageIntegrityError(
                f"the index has {package.name}=={package.version}, but no file of it for {python} "
                "with a hash that was chosen. Choose again: envhub lock --upgrade"
            )
        kept.append(Package(package.name, package.version, wheels))
    return tuple(kept)


def listed(
    versions: Sequence[str], python: str, options: Sequence[str] = (), *, refresh: bool = False
) -> tuple[Package, ...]:
    """What the index has of each ``name==version``.

    Raises:
        DependencyError: As with uv.
    """
    text = uv.run(
        [
            *("pip", "compile", "-", *uv.NO_BUILDS, "--no-deps", "--format", "pylock.toml"),
            *(
                "--no-header",
                "--no-annotate",
                *Target(python=python).options,
                *index.options(),
                *options,
            ),
            *(("--refresh",) if refresh else ()),
        ],
        what="the files of the packages could not be listed",
        given="".join(f"{one}\n" for one in versions if "==" in one),
        timeout_s=_DESCRIBE_S,
    )
    return read(toml.loads(text, "what uv says"), "what uv says")


def read(document: Mapping[str, Any], where: str) -> tuple[Package, ...]:
    """The packages in a lock file, sorted by name.

    Raises:
        LockError: It is none, or holds something else than wheels of an index.
    """
    if document.get("lock-version") != "1.0":
        raise LockError(f"{where} is no lock file of version 1.0")
    given = document.get("packages")
    if not isinstance(given, list) or len(given) > MAX_PACKAGES:
        raise LockError(f"packages in {where} is no list of at most {MAX_PACKAGES}")
    found = [_package(one, where) for one in given]
    names = [package.name for package in found]
    if len(set(names)) != len(names):
        raise LockError(f"{where} names a package twice; a lock of ours is for one interpreter")
    return tuple(sorted(found, key=lambda package: package.name))


def _package(given: object, where: str) -> Package:
    if not isinstance(given, dict):
        raise LockError(f"a package in {where} is no table")
    name, version = given.get("name"), given.get("version")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise LockError(f"{str(name)[:80]!r} in {where} is no normalized name of a package")
    try:
        if not isinstance(version, str) or not _VERSION.fullmatch(version):
            raise InvalidVersion("no text")
        Version(version)
    except InvalidVersion as error:
        raise LockError(f"{name} in {where} has no version: {str(version)[:80]!r}") from error
    if origin := read_origin(given, name, version, where):
        return Package(name, version, (), origin)
    if others := sorted({"vcs", "directory", "archive", "marker"} & given.keys()):
        raise LockError(
            f"{name} in {where} has {', '.join(others)}; only wheels of an index are installed"
        )
    wheels = given.get("wheels")
    if not isinstance(wheels, list) or not 1 <= len(wheels) <= MAX_WHEELS:
        raise LockError(f"{name} in {where} has no list of 1 to {MAX_WHEELS} wheels")
    return Package(name, version, tuple(_wheel(wheel, f"{name} in {where}") for wheel in wheels))


def _wheel(given: object, where: str) -> Wheel:
    hashes = given.get("hashes") if isinstance(given, dict) else None
    found = hashes.get("sha256") if isinstance(hashes, dict) else None
    if not isinstance(given, dict) or not isinstance(found, str) or not _SHA256.fullmatch(found):
        raise LockError(f"a wheel of {where} has no SHA-256")
    url, size = given.get("url", ""), given.get("size")
    if type(size) is not int or size < 0:
        size = None
    return Wheel(found, without_login(url) if isinstance(url, str) else "", size)


def written(packages: Sequence[Package]) -> str:
    """The packages as the standard has them."""
    lines = []
    for package in packages:
        lines += ["", "[[packages]]", f"name = {quoted(package.name)}"]
        lines += [f"version = {quoted(package.version)}"]
        if package.origin is not None:
            lines += package.origin.table
            continue
        lines += ["wheels = ["]
        for wheel in package.wheels:
            size = "" if wheel.size is None else f"size = {wheel.size}, "
            hashes = f"hashes = {{ sha256 = {quoted(wheel.sha256)} }}"
            lines.append(f"    {{ url = {quoted(wheel.url)}, {size}{hashes} }},")
        lines.append("]")
    return "\n".join([*lines, ""])


def quoted(text: str) -> str:
    """A text of TOML: JSON's is one, but for the one control character that JSON lets through."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")

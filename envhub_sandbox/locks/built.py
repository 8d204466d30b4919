"""Packages of a lock that have no wheel on an index: what they are built of, and the wheel's hash.

The source is what a lock holds to: it is fetched and hashed again. The wheel's hash says whether
the build gave the same bytes; compilers of two machines do not.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

from envhub_sandbox.dependencies import environments
from envhub_sandbox.dependencies.builds import wheel_store
from envhub_sandbox.dependencies.builds.build import identity
from envhub_sandbox.dependencies.builds.wheel_store import Built
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.dependencies.resolve import Lock
from envhub_sandbox.dependencies.sources import Source, of_git
from envhub_sandbox.errors import LockError, RequirementError

_SHA256 = re.compile(r"[0-9a-f]{64}")
_URL = re.compile(r"(?:https?|file)://[^\s\"\\]{1,2000}")


@dataclass(frozen=True)
class Origin:
    """What a wheel is built of.

    Attributes:
        source: The source distribution, or the commit.
        wheel: SHA-256 of the wheel that was built when it was locked.
        environment: Of the lock of the packages that it was built with.
    """

    source: Source
    wheel: str
    environment: str

    @property
    def identity(self) -> str:
        """What names the source's content."""
        return identity(self.source)

    @property
    def table(self) -> list[str]:
        """Lines for its package in a lock file."""
        source = self.source
        if source.commit:
            below = f", subdirectory = {_text(source.subdirectory)}" * bool(source.subdirectory)
            where = f"url = {_text(source.url)}, commit-id = {_text(source.commit)}{below}"
            first = f'vcs = {{ type = "git", {where} }}'
        else:
            hashes = f"hashes = {{ sha256 = {_text(source.sha256)} }}"
            first = f"sdist = {{ url = {_text(source.url)}, {hashes} }}"
        ours = f"wheel = {_text(self.wheel)}, environment = {_text(self.environment)}"
        return [first, f"tool = {{ envhub = {{ {ours} }} }}"]


def origins(lock: Lock) -> dict[str, Origin]:
    """What was built here of the packages of a lock, by the hash of the wheel."""
    found = {}
    for folder in (Path(option) for option in lock.options if option.startswith("/")):
        for wheel in folder.glob("*.whl"):
            built = wheel_store.describe(wheel)
            if built is not None:
                found[built.sha256] = Origin(_source(built), built.sha256, built.environment)
    return found


def _source(built: Built) -> Source:
    name, version = canonicalize_name(built.name.split("-")[0]), built.name.split("-")[1]
    kind, _, digest = built.source.partition(":")
    if kind == "sha256":
        return Source(name, version, built.url, digest)
    found = of_git(Requirement(f"{name} @ {built.source}"), "")
    assert found is not None  # which it was built of
    return found


def read(given: Mapping[str, Any], name: str, version: str, where: str) -> Origin | None:
    """What a package of a lock file is built of; None for one that has wheels on an index.

    Raises:
        LockError: It is none of ours.
    """
    tool = given.get("tool")
    ours = tool.get("envhub") if isinstance(tool, dict) else None
    if not isinstance(ours, dict):
        return None
    wheel, environment = ours.get("wheel"), ours.get("environment")
    if not all(isinstance(one, str) and _SHA256.fullmatch(one) for one in (wheel, environment)):
        raise LockError(f"{name} in {where} has no hashes of what was built")
    vcs, sdist = given.get("vcs"), given.get("sdist")
    if isinstance(vcs, dict):
        return Origin(_of_git(vcs, name, version, where), str(wheel), str(environment))
    hashes = sdist.get("hashes") if isinstance(sdist, dict) else None
    digest = hashes.get("sha256") if isinstance(hashes, dict) else None
    url = sdist.get("url") if isinstance(sdist, dict) else None
    for text, pattern in ((digest, _SHA256), (url, _URL)):
        if not isinstance(text, str) or not pattern.fullmatch(text):
            raise LockError(f"{name} in {where} has no source with a URL and a SHA-256")
    return Origin(Source(name, version, str(url), str(digest)), str(wheel), str(environment))


def _of_git(vcs: Mapping[str, Any], name: str, version: str, where: str) -> Source:
    below = f"#subdirectory={vcs['subdirectory']}" if vcs.get("subdirectory") else ""
    try:
        asked = Requirement(f"{name} @ git+{vcs.get('url')}@{vcs.get('commit-id')}{below}")
        found = of_git(asked, where)
    except (InvalidRequirement, RequirementError):
        found = None
    if found is None or not re.fullmatch(r"[0-9a-f]{40}", found.commit):
        raise LockError(f"{name} in {where} has no full commit of a repository of git")
    return Source(name, version, found.url, "", found.commit, found.subdirectory)


def with_wheels(
    lock: Lock,
    locked: Sequence[Origin],
    interpreter: Interpreter,
    tell: Callable[[str], None],
) -> Lock:
    """The lock with wheels of what has none: kept, or built again of the locked sources.

    Raises:
        DependencyError: One cannot be built, or its source is another.
    """
    from envhub_sandbox.dependencies.pipeline import build

    if not locked or environments.ready(environments.key_of(lock, interpreter)) is not None:
        return lock
    wheels = build([one.source for one in locked], interpreter, tell)
    text, options = lock.text, list(lock.options)
    for origin, wheel in zip(locked, wheels, strict=True):
        built = wheel_store.describe(wheel)
        assert built is not None
        if built.sha256 != origin.wheel:
            tell(f"{origin.source.name} was built again, and not to the same bytes")
        text = text.replace(f"sha256:{origin.wheel}", f"sha256:{built.sha256}")
        options += ["--find-links", str(wheel.parent)]
    return Lock(text, tuple(options))


def _text(text: str) -> str:
    return json.dumps(text)

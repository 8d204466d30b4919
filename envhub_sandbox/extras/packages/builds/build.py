"""Turns sources into wheels: fetches, unpacks, builds in a jail, checks, keeps.

``extras.wheel_builder`` starts the jail, since this package does not depend on sandboxes.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import environments, interpreters
from envhub_sandbox.extras.packages.builds import apart, download, project, wheels
from envhub_sandbox.extras.packages.builds.wheels import MAX_BYTES
from envhub_sandbox.extras.packages.declared import Source, parse_requirement
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.extras.packages.request import PackageRequest, Tell
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.extras.packages.resolution.resolve import MOST_SOURCES
from envhub_sandbox.hub.logins import without_login
from envhub_worker.protocol.runtime import OWN
from envhub_worker.protocol.text import printable

PROFILE_VARIABLE = "ENVHUB_BUILD_PROFILE"
WALL_S = 1800.0
LIMITS = {"memory_bytes": "8G", "disk_bytes": "6G", "disk_files": 400_000, "cpu_time_s": 7200}
_PROGRAM = "envhub_sandbox.extras.wheel_builder"
_SHOWN = 6000
_AROUND_S = 900.0
_MOST_REQUIRED = 200


class BuildFailedError(DependencyError):
    """The build backend failed or was ended; the text is the end of its output."""


def _in_jail(order: Mapping[str, Any], folder: Path, title: str) -> Path | tuple[str, ...]:
    """Returns a wheel below an empty folder, or the further requirements of the build backend.

    Trust: both are a stranger's, unchecked. ``extras.wheel_builder`` reads the order; this function
    adds limits, profile and readable folders. Raises ``BuildFailedError``, or ``DependencyError``
    where this host cannot start a jail.
    """
    whole = {
        **order,
        "folder": str(folder),
        "readable": [order["source"], order["packages"], str(folder / "tools")],
        "limits": LIMITS,
        "wall_s": WALL_S,
        "max_bytes": MAX_BYTES,
        "profile": os.environ.get(PROFILE_VARIABLE) or "strict",
    }
    answer = apart.answer_of(_PROGRAM, whole, WALL_S + _AROUND_S, f"building {title}")
    if "unconfined" in answer:
        raise DependencyError(
            f"sources are built in a jail, and there is none here: {answer['unconfined']}. A "
            f"weaker profile for builds is chosen by {PROFILE_VARIABLE}, as in "
            f"{PROFILE_VARIABLE}=no-userns"
        )
    if "failed" in answer:
        raise BuildFailedError(printable(str(answer["failed"])[-_SHOWN:], _SHOWN))
    further, name = answer.get("requires"), answer.get("wheel")
    if isinstance(further, list) and 0 < len(further) <= _MOST_REQUIRED:
        return tuple(text for text in further if isinstance(text, str))
    if not isinstance(name, str):
        raise BuildFailedError("its build backend produced no wheel")
    return folder / "wheel" / os.path.basename(name)


Choose = Callable[[PackageRequest, Interpreter, Tell], Lock]
_DEEPEST = 8
_ROUNDS = 3
"""Backends may name further requirements; once these are installed, they may name more."""
_UNDER_WAY: ContextVar[tuple[str, ...]] = ContextVar("sources that are being built", default=())
_BUILDS: ContextVar[Iterator[int]] = ContextVar("how many were built for one request")


def build_wheels(
    sources: Sequence[Source], interpreter: Interpreter, tell: Tell, choose: Choose
) -> list[Path]:
    """Returns a wheel for each source: kept from before, or built in a jail without network.

    ``choose`` resolves versions of the build requirements. Raises ``DependencyError`` where a build
    fails (the text names what this machine lacks), where a check refuses sources or a wheel, or
    where this host cannot start a jail.
    """
    if not _UNDER_WAY.get():
        _BUILDS.set(itertools.count(1))
    return [_wheel(source, interpreter, tell, choose) for source in sources]


def _wheel(source: Source, interpreter: Interpreter, tell: Tell, choose: Choose) -> Path:
    if source.commit:
        source = replace(source, commit=download.resolve(source.url, source.commit))
    kept = wheels.recall(source, interpreter)
    if kept is not None:
        wheels.named(kept.name, source.name, source.version)  # same commit, other name
        return kept
    with _under_way(source), tempfile.TemporaryDirectory(prefix="envhub-build-") as place:
        Path(place).chmod(0o755)  # the jail runs as another user
        tree = _fetched(source, Path(place), tell)
        declared = project.read(tree, _title(source))
        return _Build(source, declared, tree, Path(place), interpreter, tell, choose).wheel()


@contextmanager
def _under_way(source: Source) -> Iterator[None]:
    """Refuse a source that its own build requires."""
    above = _UNDER_WAY.get()
    chain = (*above, source.name)
    if source.name in above or len(chain) > _DEEPEST:
        raise DependencyError(
            f"{source.name} cannot be built: its build requirement has no wheel, and is built with "
            f"it in turn ({' <- '.join(chain)})",
            reason="resolution",
        )
    if next(_BUILDS.get()) > MOST_SOURCES:
        raise DependencyError(
            f"{chain[0]} needs more than {MOST_SOURCES} packages to be built", reason="resolution"
        )
    token = _UNDER_WAY.set(chain)
    try:
        yield
    finally:
        _UNDER_WAY.reset(token)


def _fetched(source: Source, place: Path, tell: Tell) -> Path:
    """Fetches the source's files; returns their folder."""
    tree = place / "source"
    tree.mkdir()
    tell(f"fetching the source of {_title(source)}")
    if source.commit:
        download.check_out(source.url, source.commit, tree, tell)
        folder = tree
        for step in filter(None, source.subdirectory.split("/")):
            if step in (".", "..") or not (folder / step).is_dir():
                raise DependencyError(
                    f"{_title(source)} has no folder {source.subdirectory[:200]!r}. {source.where}",
                    reason="requirement",
                )
            folder = folder / step
        return folder
    archive = place / Path(unquote(urlsplit(source.url).path)).name
    return apart.fetch(source.url, source.sha256, archive, tree, _title(source))


def _title(source: Source) -> str:
    if source.commit:
        return f"{source.name} ({without_login(source.url)}@{source.commit[:12]})"
    return f"{source.name} {source.version}"


@dataclass(frozen=True)
class _Build:
    """The build of one unpacked source."""

    _source: Source
    _project: project.Project
    _tree: Path
    _place: Path
    _interpreter: Interpreter
    _tell: Tell
    _choose: Choose

    def wheel(self) -> Path:
        """Builds, checks and keeps the wheel. Raises ``DependencyError``."""
        further: tuple[str, ...] = ()
        while True:
            try:
                return self._tried(further)
            except BuildFailedError as failed:
                if not (more := self._remedy(str(failed), further)):
                    source, advice = self._source, project.advice(str(failed))
                    advice = f"{advice}. " if advice else ""
                    needed_by = f" ({source.where})" if source.where else ""
                    raise DependencyError(
                        f"{_title(source)}{needed_by} has no wheel for Python "
                        f"{self._interpreter.version}, and building its source in a jail failed. "
                        f"{advice}The build says:\n{failed}",
                        reason="resolution",
                    ) from failed
                further = (*further, *more)

    def _remedy(self, log: str, tried: tuple[str, ...]) -> tuple[str, ...]:
        """Returns requirements with which a second attempt may succeed; empty if none is known.

        A wheel may bring the program that the build lacked. Today's setuptools may reject old
        sources: then an older setuptools is tried.
        """
        program = project.wheel_for(log)
        if program and program not in tried:
            return (program,)
        # they bring pkg_resources; no setuptools before 66.1 runs in Python 3.12
        is_old = tuple(map(int, self._interpreter.version.split(".")[:2])) < (3, 12)
        old = ("setuptools<66" if is_old else "setuptools<81", "wheel<0.40")
        is_setuptools = self._project.backend.startswith("setuptools.")
        return old if is_setuptools and not project.advice(log) and old[0] not in tried else ()

    def _tried(self, further: tuple[str, ...]) -> Path:
        requirements: tuple[str, ...] = ()
        for number in range(_ROUNDS):
            packages, lock = self._environment((*further, *requirements))
            self._tell(f"building {_title(self._source)} in a jail")
            folder = Path(tempfile.mkdtemp(prefix=f"try-{number}-", dir=self._place))
            folder.chmod(0o755)
            order = self._order(packages, requirements)
            result = _in_jail(order, folder, _title(self._source))
            if isinstance(result, Path):
                source, interpreter = self._source, self._interpreter
                apart.check_wheel(result, source.name, source.version, interpreter)
                return wheels.keep(result, self._source, lock, self._interpreter)
            requirements = (*requirements, *result)
        raise BuildFailedError("its build backend always asks for further packages")

    def _environment(self, further: Iterable[str]) -> tuple[Path, str]:
        """Returns the folder of the build requirements, and the hash of their lock."""
        origin = f"what {_title(self._source)} is built with"
        wanted = [*self._project.requires, *(parse_requirement(text, origin) for text in further)]
        if not wanted:
            (self._place / "nothing").mkdir(exist_ok=True)
            return self._place / "nothing", Lock(()).digest
        request = PackageRequest(origin, tuple(wanted), runs_worker=False)
        lock = self._choose(request, self._interpreter, self._tell)
        return environments.provide(lock, self._interpreter, self._tell).packages, lock.digest

    def _order(self, packages: Path, known: tuple[str, ...]) -> dict[str, object]:
        # without ``.git``, backends that take the version from git need this variable
        version = {"SETUPTOOLS_SCM_PRETEND_VERSION": f"0+g{self._source.commit[:12]}"}
        return {
            "source": str(self._tree),
            "packages": str(packages),
            "python": self._interpreter.path,
            "runtime": self._runtime(),
            "backend": self._project.backend,
            "backend_path": self._project.backend_path,
            "known": (*(str(package.requirement) for package in self._project.requires), *known),
            "environment": version if self._source.commit else {},
        }

    def _runtime(self) -> tuple[str, str]:
        """Returns interpreter and packages of the jail's own code: ours, or a new environment."""
        if self._interpreter == interpreters.own():
            return OWN
        lock = self._choose(
            PackageRequest("the jail of a build", ()), self._interpreter, self._tell
        )
        environment = environments.provide(lock, self._interpreter, self._tell)
        return environment.python, str(environment.packages)

"""Chooses versions and interpreter for a repository once, and remembers them.

The key covers everything that the choice depends on: the same repository gets the same packages on
this machine until the caller requests newer ones, and needs no index a second time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.utils import canonicalize_name, parse_wheel_filename

from envhub_sandbox.errors import DependencyError, EnvHubError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.declared import Source, of_git, parse_requirement
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.extras.packages.request import PackageRequest, Tell, chosen
from envhub_sandbox.extras.packages.resolution import index, pylock, resolve
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.extras.packages.resolution.resolve import WORKERS, Target
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import folders
from envhub_sandbox.system.log import warn_caller

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.modules import Guess

_FORMAT = 3
_MOST_CURES = 6
_CHECK_S = 60.0
Builder = Callable[[Sequence[Source], Interpreter, Tell], Sequence[Path]]
"""Makes one wheel of each source, in the same order. Each wheel lies in a folder that holds only
wheels, and stays there. Raises ``DependencyError``."""


@dataclass(frozen=True)
class Resolution:
    """Versions and their interpreter; ``taken``: the undeclared modules whose packages are
    included.
    """

    lock: Lock
    interpreter: Interpreter
    taken: tuple[str, ...] = ()


def build(sources: Sequence[Source], interpreter: Interpreter, tell: Tell) -> list[Path]:
    """Returns a wheel of each source, in the same order: kept from before, or built in a jail."""
    from envhub_sandbox.extras.packages.builds.build import build_wheels

    return build_wheels(sources, interpreter, tell, partial(_lock_for, builder=BUILDER))


BUILDER: Builder | None = build
"""Makes wheels of packages without one; None permits no builds."""


def resolution_for(
    request: PackageRequest, tell: Tell = lambda line: None, *, upgrade: bool = False
) -> Resolution:
    """Returns versions for an interpreter of this machine: remembered, or newly chosen.

    Raises ``DependencyError``, with what to change, if there are no versions, no interpreter, no
    index or no uv.
    """
    first = interpreters.find(request.python, request.supports, fetch=request.fetch_python)
    key = key_of(request, first)
    recalled = None if upgrade else recall(key)
    if recalled is not None:
        return recalled
    tell(f"choosing versions for {request.source}")
    resolution = _chosen(request, first, upgrade, tell)
    strict = option_name("dependencies", "declared")
    for guess in request.guesses:
        if guess.module in resolution.taken:
            text = (
                f"{guess.wanted.requirement} is installed, which nothing declares "
                f"({guess.wanted.where}); {strict} takes what is declared alone"
            )
            warn_caller(text)
    remember(key, resolution)
    return resolution


def _chosen(request: PackageRequest, first: Interpreter, refresh: bool, tell: Tell) -> Resolution:
    """Chooses the first interpreter that has versions, from wheels alone if possible."""
    tried: list[str] = []
    failed: list[DependencyError] = []
    for attempt, builder in _attempts(request):
        failed.clear()
        for candidate in _candidates(first, request):
            tried.append(candidate.version)
            lock = partial(
                _lock_for, interpreter=candidate, tell=tell, builder=builder, refresh=refresh
            )
            try:
                versions, taken = versions_for(attempt, lock)
                versions = _with_newest(attempt, taken, versions, candidate, tell)
                return Resolution(versions, candidate, tuple(guess.module for guess in taken))
            except DependencyError as error:
                if error.reason != "resolution":
                    raise
                failed.append(error)
                if not resolve.is_about_python(error):
                    break
    cure = _cure(request, failed[0], first)
    advice_text = resolve.advice(request.python, list(dict.fromkeys(tried)), failed[0], cure)
    raise DependencyError(f"{failed[0]}\n{advice_text}", reason="resolution") from failed[0]


def _with_newest(
    request: PackageRequest,
    taken: Sequence[Guess],
    lock: Lock,
    interpreter: Interpreter,
    tell: Tell,
) -> Lock:
    """Returns a lock with the releases that pip would take of the packages that a request names:
    those without a wheel are built. Where that fails, an older wheel stays, with a warning.
    """
    wanted = (*request.wanted, *(guess.wanted for guess in taken))
    request, target = replace(request, wanted=wanted, guesses=()), Target(python=interpreter.path)
    kept: list[Source] = []
    for source in resolve.newer_sources(request, lock, target) if BUILDER is not None else ():
        try:
            both = (*kept, source)
            lock = _lock_for(request, interpreter, tell, builder=BUILDER, sources=both)
            kept.append(source)
        except DependencyError as error:
            if error.reason in ("index", "integrity"):
                raise
            [old] = [pin for pin in lock.packages if pin.startswith(f"{source.name}==")]
            older = option_name("dependencies", {"override": [old]})
            text = f"{old} is installed, the newest that has a wheel; {older} asks for it. {error}"
            warn_caller(text)
    return lock


def has_versions(request: PackageRequest) -> bool:
    """Tells whether there are versions for a request; builds and fetches nothing. True if only the
    build of a source, or an index, could tell.
    """
    asked = {
        canonicalize_name(one.requirement.name) for one in (*request.wanted, *request.override)
    }
    for target in _targets(request):
        try:
            resolve.resolve(replace(request, guesses=()), target, timeout_s=_CHECK_S)
            return True
        except DependencyError as error:
            unbuilt = set(resolve.without_wheels(error))
            if error.reason != "resolution" or (unbuilt and asked.isdisjoint(unbuilt)):
                return True
    return False


def _targets(request: PackageRequest) -> Iterator[Target]:
    try:
        first = interpreters.find(request.python, request.supports)
    except DependencyError:
        if request.fetch_python:
            yield Target(version=request.python, machine=interpreters.own().machine)
        return
    yield from (Target(python=one.path) for one in _candidates(first, request))


def _cure(
    request: PackageRequest, error: DependencyError, interpreter: Interpreter
) -> dict[str, list[str]] | None:
    """Returns keys of ``dependencies`` with which a resolution succeeds; None if none is known."""
    for keys in islice(resolve.cures(error), _MOST_CURES):
        with contextlib.suppress(EnvHubError):
            changed = chosen(keys, None)[0]
            asked = replace(
                request,
                guesses=(),
                without=(*request.without, *changed.without),
                override=(*request.override, *changed.override),
            )
            resolve.resolve(asked, Target(python=interpreter.path))
            return keys
    return None


def _attempts(request: PackageRequest) -> Iterator[tuple[PackageRequest, Builder | None]]:
    """Yields requests and their builders; requests without guesses come last."""
    every = (*request.wanted, *(guess.wanted for guess in request.guesses))
    wheels_alone = BUILDER is None or not any(package.requirement.url for package in every)
    ways = [*([None] if wheels_alone else []), *([BUILDER] if BUILDER else [])]
    less = [replace(request, guesses=())] if request.guesses and request.wanted else []
    return ((attempt, builder) for attempt in (request, *less) for builder in ways)


def _candidates(first: Interpreter, request: PackageRequest) -> Iterator[Interpreter]:
    yield first
    if not request.python:
        yield from interpreters.others(request.supports, first)


def _lock_for(
    request: PackageRequest,
    interpreter: Interpreter,
    tell: Tell,
    *,
    builder: Builder | None,
    refresh: bool = False,
    sources: Sequence[Source] = (),
) -> Lock:
    """Resolves a request; each round builds packages without wheels and resolves their needs.
    ``sources`` are built before, and taken.
    """
    target = Target(python=interpreter.path)
    links: list[str] = []
    if builder is not None:
        request, links = _built_from_git(request, builder, interpreter, tell)
        links += _links(builder(sources, interpreter, tell)) if sources else []
        held = (parse_requirement(f"{one.name}=={one.version}", "the newest") for one in sources)
        request = replace(request, constraints=(*request.constraints, *held))
    built = {source.name for source in sources}
    while True:
        try:
            lock = resolve.resolve(request, target, options=links, refresh=refresh, tell=tell)
            break
        except DependencyError as error:
            names = sorted(set(resolve.without_wheels(error)) - built)
            if error.reason != "resolution" or builder is None or not names:
                raise
            # a package's needs are known once it is built, and may change the other versions
            sources = resolve.sources_of(request, target, names, links)
            if built.issuperset(one.name for one in sources):
                raise
        built.update(one.name for one in sources)
        links += _links(builder(sources, interpreter, tell))
    return resolve.without_cuda(
        request,
        lock,
        lambda asked, more: resolve.resolve(asked, target, options=[*links, *more], tell=tell),
    )


def _links(wheels: Sequence[Path]) -> list[str]:
    folders = dict.fromkeys(str(wheel.parent) for wheel in wheels)
    return [word for folder in folders for word in ("--find-links", folder)]


def _built_from_git(
    request: PackageRequest, builder: Builder, interpreter: Interpreter, tell: Tell
) -> tuple[PackageRequest, list[str]]:
    """Replaces git repositories in a request by built wheels; returns also the wheels' folders."""
    wanted, wheels = [], []
    for package in request.wanted:
        source = of_git(package.requirement, package.where) if package.requirement.url else None
        if source is None:
            wanted.append(package)
            continue
        [wheel] = builder([source], interpreter, tell)
        wheels.append(wheel)
        extras = ",".join(sorted(package.requirement.extras))
        text = f"{source.name}[{extras}]=={parse_wheel_filename(wheel.name)[1]}"
        wanted.append(parse_requirement(text, package.where))
    return replace(request, wanted=tuple(wanted)), _links(wheels)


def versions_for(
    request: PackageRequest, resolved: Callable[[PackageRequest], Lock]
) -> tuple[Lock, tuple[Guess, ...]]:
    """Returns versions, and the guesses that no other package covers; ``resolved`` resolves a
    request without its guesses.
    """
    taken = request.guesses
    if request.wanted or not taken:
        lock = resolved(request)
        names = {pin.partition("==")[0] for pin in lock.packages}
        taken = tuple(guess for guess in request.guesses if not guess.is_among(names))
        if not taken:
            return lock, ()
    wanted = (*request.wanted, *(guess.wanted for guess in taken))
    return resolved(replace(request, wanted=wanted, guesses=())), taken


def root() -> Path:
    """Returns the folder of resolutions; private to this user, since we install what they list."""
    return folders.cache_root() / "resolutions"


def key_of(request: PackageRequest, interpreter: Interpreter) -> str:
    """Hashes everything that a resolution depends on, including the sources of packages."""
    parts = [
        sorted(map(str, rows)) for rows in (request.wanted, request.constraints, request.override)
    ]
    parts.append(sorted(str(guess.wanted.requirement) for guess in request.guesses))
    rest = [request.without, request.exclude_newer, request.python, request.supports, request.gpu]
    facts = [_FORMAT, WORKERS, parts, asdict(interpreter), rest, index.places()]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def recall(key: str) -> Resolution | None:
    """Returns the remembered resolution, if there is one and its interpreter is unchanged."""
    try:
        facts = json.loads(folders.recall(root(), key) or "{}")
        packages = pylock.read(pylock.document(facts["lock"], key), key)
        lock = Lock(packages, tuple(map(str, facts["options"])))
        interpreter = Interpreter(**facts["interpreter"])
        # each lock includes the worker's needs: an empty one is damaged
        is_fresh = _stamp(interpreter) == facts["stamp"] and all(
            os.sep not in option or os.path.isdir(option) for option in lock.options
        )
        if lock.packages and is_fresh:
            return Resolution(lock, interpreter, tuple(map(str, facts["taken"])))
    except (OSError, ValueError, LookupError, TypeError):
        pass
    return None


def remember(key: str, found: Resolution) -> None:
    """Remember a resolution. An unwritable cache is no error."""
    facts = {
        "lock": f'lock-version = "1.0"\n{pylock.written(found.lock.pinned)}',
        "options": found.lock.options,
        "interpreter": asdict(found.interpreter),
        "stamp": _stamp(found.interpreter),
        "taken": found.taken,
    }
    folders.keep(root(), key, json.dumps(facts))


def _stamp(interpreter: Interpreter) -> list[int]:
    """Returns size and time of the interpreter's file: these change with an upgrade in place."""
    status = os.stat(interpreter.path)
    return [status.st_size, status.st_mtime_ns]

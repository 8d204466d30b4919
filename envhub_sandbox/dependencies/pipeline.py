"""From a repository's files to the packages that it runs with: the same steps for every place.

read what it is to have (``request_of``), take the place's own packages if they meet it, choose
versions (``resolution_for``), make an environment. What differs between this machine, a container
and a server on another host is a ``PackageTarget``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from envhub_sandbox.dependencies import progress
from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.request import PackageRequest, request_of
from envhub_sandbox.errors import (
    DependencyError,
    IndexUnavailableError,
    ResolutionError,
    name_source,
)
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.option_names import option_name
from envhub_sandbox.system.log import DEPENDENCIES

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.environments import Environment
    from envhub_sandbox.dependencies.guesses import Guess
    from envhub_sandbox.dependencies.interpreters import Interpreter
    from envhub_sandbox.dependencies.resolutions import Resolution
    from envhub_sandbox.dependencies.resolve import Lock
    from envhub_sandbox.dependencies.sources import Builder, Source

Tell = Callable[[str], None]


def lock_for(request: PackageRequest, interpreter: Interpreter, tell: Tell) -> Lock:
    """Versions for one interpreter; what has no wheel is built."""
    return _Attempt(request, BUILDER).lock(request, interpreter, False, tell)


def build(sources: Sequence[Source], interpreter: Interpreter, tell: Tell) -> list[Path]:
    """A wheel of each source, in the same order: kept from before, or built in a jail."""
    from envhub_sandbox.dependencies.builds.build import build_wheels

    return build_wheels(sources, interpreter, tell, lock_for)


BUILDER: Builder | None = build
"""Makes wheels of packages that have none."""


@dataclass(frozen=True)
class PackageSet:
    """Packages that were made for a repository.

    Attributes:
        packages: Their folder, or their name in the place that has them.
        facts: What is in it, as plain data.
        python: The interpreter that they are for; empty where the place knows it.
        environment: The folder's record, where it is on this machine.
    """

    packages: str
    facts: dict[str, Any]
    python: str = ""
    environment: Environment | None = None

    @classmethod
    def of(cls, made: Environment) -> PackageSet:
        """A folder of this machine."""
        return cls(str(made.packages), made.facts, made.python, made)


class PackageTarget(Protocol):
    """A place that a repository's packages are for."""

    def meets(self, request: PackageRequest) -> bool:
        """Whether what is installed there is enough."""

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet | None:
        """Packages of the repository's own; None where the place says that its own are enough."""


class ThisMachine:
    """The interpreters of this machine.

    Args:
        upgrade: Choose versions again, although it is known which were chosen before.
    """

    def __init__(self, *, upgrade: bool = False) -> None:
        self._upgrade = upgrade

    def meets(self, request: PackageRequest) -> bool:
        """Whether this process's interpreter has all of it."""
        from envhub_sandbox.dependencies import guesses, host

        return host.lacks(request) is None and all(map(guesses.is_here, request.guesses))

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet:
        """An environment; raises as ``resolution_for`` and ``environments.provide``."""
        from envhub_sandbox.dependencies import environments

        found = resolution_for(request, tell, upgrade=self._upgrade)
        made = PackageSet.of(environments.provide(found.lock, found.interpreter, tell))
        inferred = [one.facts for one in request.guesses if one.module in found.taken]
        return replace(made, facts=made.facts | {"inferred": inferred}) if inferred else made


HERE = ThisMachine()


def packages_for(
    snapshot: Snapshot, choice: Choice, target: PackageTarget = HERE, *, gpu: bool = False
) -> PackageSet | None:
    """The packages that a repository runs with; None for those that the place has.

    Progress is shown where somebody looks.

    Raises:
        DependencyError: They cannot be made; the text says what to change.
    """
    try:
        request = request_of(snapshot, choice, gpu=gpu)
        if request is None or (not request.always and target.meets(request)):
            return None
        with progress.shown("packages") as tell:
            try:
                return target.make(request, tell)
            except (ResolutionError, IndexUnavailableError) as error:
                if request.wanted or request.always:
                    raise
                # what it imports was read, and not said: it may do without
                DEPENDENCIES.warning("%s: nothing is installed for it: %s", snapshot.label, error)
                return None
    except DependencyError as error:
        name_source(error, snapshot.label)
        raise


def resolution_for(
    request: PackageRequest, tell: Tell = lambda line: None, *, upgrade: bool = False
) -> Resolution:
    """Versions for an interpreter of this machine: remembered, or chosen.

    Raises:
        ResolutionError: There are none; the text says what to change.
        DependencyError: There is no interpreter, no index, or no uv.
    """
    from envhub_sandbox.dependencies import interpreters, resolutions

    first = interpreters.find(request.python, request.supports, fetch=request.fetch_python)
    key = resolutions.key_of(request, first)
    known = None if upgrade else resolutions.recall(key)
    if known is not None:
        return known
    tell(f"choosing versions for {request.source}")
    found = _chosen(request, first, upgrade, tell)
    for one in request.guesses:
        if one.module in found.taken:
            warnings.warn(_taken(one), stacklevel=2)
    resolutions.remember(key, found)
    return found


def _taken(one: Guess) -> str:
    strict = option_name("dependencies", "declared")
    return (
        f"{one.wanted.requirement} is installed, which nothing declares ({one.wanted.where}); "
        f"{strict} takes what is declared alone"
    )


def _chosen(request: PackageRequest, first: Interpreter, refresh: bool, tell: Tell) -> Resolution:
    """By the first interpreter that has versions, of wheels alone if that can be.

    What is only guessed stands in nobody's way: in the end it is done without.
    """
    from envhub_sandbox.dependencies import interpreters, resolve

    tried: list[Interpreter] = []
    failed: list[ResolutionError] = []
    for attempt in _attempts(request):
        failed.clear()
        for one in _candidates(first, request, interpreters.others):
            tried.append(one)
            try:
                return _for_interpreter(attempt, one, refresh, tell)
            except ResolutionError as error:
                failed.append(error)
                if not resolve.is_about_python(error):
                    break
    versions = list(dict.fromkeys(one.version for one in tried))
    what = resolve.advice(request.python, versions, failed[0])
    raise ResolutionError(f"{failed[0]}\n{what}") from failed[0]


def _attempts(request: PackageRequest) -> Iterator[_Attempt]:
    every = (*request.wanted, *(guess.wanted for guess in request.guesses))
    wheels_alone = BUILDER is None or not any(one.requirement.url for one in every)
    ways = [*([None] if wheels_alone else []), *([BUILDER] if BUILDER else [])]
    less = [replace(request, guesses=())] if request.guesses and request.wanted else []
    for asked in (request, *less):
        for builder in ways:
            yield _Attempt(asked, builder)


def _candidates(
    first: Interpreter,
    request: PackageRequest,
    others: Callable[[str, Interpreter], list[Interpreter]],
) -> Iterator[Interpreter]:
    yield first
    if not request.python:
        yield from others(request.supports, first)


def _for_interpreter(
    attempt: _Attempt, interpreter: Interpreter, refresh: bool, tell: Tell
) -> Resolution:
    from envhub_sandbox.dependencies.resolutions import Resolution

    lock, taken = versions_for(
        attempt.request,
        lambda request: attempt.lock(request, interpreter, refresh, tell),
    )
    return Resolution(lock, interpreter, tuple(one.module for one in taken))


@dataclass(frozen=True)
class _Attempt:
    """A way to come by versions: of wheels alone, or with a builder of what has none.

    Attributes:
        request: What is asked for.
        builder: Makes wheels of sources.
    """

    request: PackageRequest
    builder: Builder | None

    def lock(
        self, request: PackageRequest, interpreter: Interpreter, refresh: bool, tell: Tell
    ) -> Lock:
        """Versions; each round builds what has no wheel and then looks at what that needs."""
        from envhub_sandbox.dependencies import torch_cpu
        from envhub_sandbox.dependencies.resolve import (
            Target,
            needs_other_python,
            resolve,
            sources_of,
            without_wheels,
        )

        target = Target(python=interpreter.path)
        links: list[str] = []
        if self.builder is not None:
            request, links = _built_from_git(request, self.builder, interpreter, tell)
        built: set[str] = set()
        while True:
            try:
                lock = resolve(request, target, options=links, refresh=refresh, tell=tell)
                break
            except ResolutionError as error:
                names = sorted(set(without_wheels(error)) - built)
                if self.builder is None or not names or needs_other_python(error):
                    raise
                # what one needs is known once it is built: then others may be chosen
                sources = sources_of(request, target, names, links)
                if built.issuperset(one.name for one in sources):
                    raise
            built.update(one.name for one in sources)
            links += _links(self.builder(sources, interpreter, tell))
        return torch_cpu.smaller(
            request,
            lock,
            lambda asked, more: resolve(asked, target, options=[*links, *more], tell=tell),
        )


def _links(wheels: Sequence[Path]) -> list[str]:
    folders = dict.fromkeys(str(wheel.parent) for wheel in wheels)
    return [word for folder in folders for word in ("--find-links", folder)]


def _built_from_git(
    request: PackageRequest, builder: Builder, interpreter: Interpreter, tell: Tell
) -> tuple[PackageRequest, list[str]]:
    """The request with versions of wheels instead of repositories, and where these wheels are."""
    from packaging.utils import parse_wheel_filename

    from envhub_sandbox.dependencies.declared import parse_requirement
    from envhub_sandbox.dependencies.sources import of_git

    wanted, wheels = [], []
    for one in request.wanted:
        source = of_git(one.requirement, one.where) if one.requirement.url else None
        if source is None:
            wanted.append(one)
            continue
        [wheel] = builder([source], interpreter, tell)
        wheels.append(wheel)
        extras = ",".join(sorted(one.requirement.extras))
        text = f"{source.name}[{extras}]=={parse_wheel_filename(wheel.name)[1]}"
        wanted.append(parse_requirement(text, one.where))
    return replace(request, wanted=tuple(wanted)), _links(wheels)


def versions_for(
    request: PackageRequest, resolved: Callable[[PackageRequest], Lock]
) -> tuple[Lock, tuple[Guess, ...]]:
    """Versions, and what was taken that nothing else brings.

    Args:
        request: What is asked for.
        resolved: Gives versions for a request, without its guesses.

    Raises:
        ResolutionError: There are none.
    """
    taken = request.guesses
    if request.wanted or not taken:
        lock = resolved(request)
        names = {pin.partition("==")[0] for pin in lock.packages}
        taken = tuple(one for one in request.guesses if not one.is_among(names))
        if not taken:
            return lock, ()
    return resolved(request.plus(taken)), taken

"""From a repository's files to the packages that it runs with: the same steps for every place.

read what it is to have (``request_of``), take the place's own packages if they meet it, choose
versions (``resolution_for``), make an environment. What differs between this machine, a container
and a server on another host is a ``PackageTarget``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from envhub_sandbox.dependencies import progress
from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.request import PackageRequest, request_of
from envhub_sandbox.errors import DependencyError, name_source
from envhub_sandbox.hub.snapshot import Snapshot

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.environments import Environment
    from envhub_sandbox.dependencies.resolutions import Resolution

Tell = Callable[[str], None]


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
        from envhub_sandbox.dependencies import host

        return host.lacks(request) is None

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet:
        """An environment; raises as ``resolution_for`` and ``environments.provide``."""
        from envhub_sandbox.dependencies import environments

        found = resolution_for(request, tell, upgrade=self._upgrade)
        return PackageSet.of(environments.provide(found.lock, found.interpreter, tell))


HERE = ThisMachine()


def packages_for(
    snapshot: Snapshot, choice: Choice, target: PackageTarget = HERE
) -> PackageSet | None:
    """The packages that a repository runs with; None for those that the place has.

    Progress is shown where somebody looks.

    Raises:
        DependencyError: They cannot be made; the text says what to change.
    """
    try:
        request = request_of(snapshot, choice)
        if request is None or (not request.always and target.meets(request)):
            return None
        with progress.shown("packages") as tell:
            return target.make(request, tell)
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
    from envhub_sandbox.dependencies.resolutions import Resolution
    from envhub_sandbox.dependencies.resolve import Target, resolve

    interpreter = interpreters.find(request.python, request.supports)
    key = resolutions.key_of(request, interpreter)
    known = None if upgrade else resolutions.recall(key, interpreter)
    if known is not None:
        return known
    tell(f"choosing versions for {request.source}")
    lock = resolve(request, Target(python=interpreter.path), refresh=upgrade, tell=tell)
    found = Resolution(lock, interpreter)
    resolutions.remember(key, found)
    return found

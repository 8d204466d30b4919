"""From a repository's files to the packages that it runs with: the same steps for every place.

read what it is to have (``request_of``), take the place's own packages if they meet it, choose
versions (``resolution_for``), make an environment. What differs between this machine, a container
and a server on another host is a ``PackageTarget``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from envhub_sandbox.dependencies.request import Choice, PackageRequest, request_of
from envhub_sandbox.errors import (
    DependencyError,
    IndexUnavailableError,
    ResolutionError,
    name_source,
)
from envhub_sandbox.hub.registered import reference as registered
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.system import progress
from envhub_sandbox.system.log import DEPENDENCIES
from envhub_worker.protocol.records import dataclass

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.environments import Environment

_CHECK_REFERENCE = (
    "The reference names the package: is it spelt so, and has the index that version?"
)
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
    """The interpreters of this machine; with ``upgrade``, versions are chosen again."""

    def __init__(self, *, upgrade: bool = False) -> None:
        self._upgrade = upgrade

    def meets(self, request: PackageRequest) -> bool:
        """Whether this process's interpreter has all of it."""
        from envhub_sandbox.dependencies import installed, modules

        met = installed.first_unmet(request) is None
        return met and all(map(modules.is_here, request.guesses))

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet:
        """An environment; raises as ``resolution_for`` and ``environments.provide``."""
        from envhub_sandbox.dependencies import environments, resolutions

        found = resolutions.resolution_for(request, tell, upgrade=self._upgrade)
        made = PackageSet.of(environments.provide(found.lock, found.interpreter, tell))
        inferred = [one.facts for one in request.guesses if one.module in found.taken]
        return replace(made, facts=made.facts | {"inferred": inferred}) if inferred else made


HERE = ThisMachine()


def packages_for(
    snapshot: Snapshot, choice: Choice, target: PackageTarget = HERE, *, gpu: bool = False
) -> PackageSet | None:
    """The packages that a repository runs with; None for those that the place has.

    Progress is shown on a terminal. Raises ``DependencyError``, with what to change.
    """
    try:
        request = request_of(snapshot, choice, gpu=gpu)
        if request is None or (not request.always and target.meets(request)):
            return None
        with progress.progress_shown("packages") as tell:
            try:
                return target.make(request, tell)
            except (ResolutionError, IndexUnavailableError) as error:
                if request.wanted or request.always:
                    raise
                # what it imports was read, and not said: it may do without
                DEPENDENCIES.warning("%s: nothing is installed for it: %s", snapshot.label, error)
                return None
    except DependencyError as error:
        if snapshot.repo_type == registered.KIND and isinstance(error, ResolutionError):
            error.args = (f"{error}\n{_CHECK_REFERENCE}", *error.args[1:])
        name_source(error, snapshot.label)
        raise

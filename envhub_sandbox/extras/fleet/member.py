"""A place of a fleet, prepared for one repository, and the repository's packages on all places."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import EnvHubError, PolicyError
from envhub_sandbox.extras.packages.packages import PackageSet
from envhub_sandbox.extras.packages.request import PackageRequest, Tell
from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox, may_go_elsewhere
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.threads import Calls
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.runtime import OWN, Runtime

ForRepository = Callable[[Sandbox, Runtime], Sandbox]
"""Makes the sandbox of one repository from a place's sandbox and the runtime of its jails."""


class Member(Sandbox):
    """A place of a fleet.

    Its packages may differ from those of other places, because each has its own interpreter.

    Args:
        sandbox: The place's sandbox, before ``open_for``.
        runtime: Makes the runtime of the place's jails; ``open_for`` calls it first, once.

    Attributes:
        sandbox: The place's sandbox, before ``open_for``.
        weight: How often the caller's list has this place.
        absent: Whether the place could not make packages because it had no room or no answer came.
    """

    def __init__(
        self, sandbox: Sandbox, runtime: Callable[[Member], Runtime], weight: int = 1
    ) -> None:
        self.sandbox = sandbox
        self.name, self.retry_s = sandbox.name, sandbox.retry_s
        self.weight = weight
        self.absent = False
        self._opening = threading.RLock()  # interruption.md, rule 12
        self._make_runtime = runtime
        self._runtime: Runtime | None = None
        self._opened: tuple[Sandbox, Runtime] | None = None

    @property
    def is_open(self) -> bool:
        """Whether ``open_for`` has prepared the place for the repository."""
        return self._opened is not None

    @property
    def address(self) -> str:
        """See ``Sandbox``."""
        return (self._opened[0] if self._opened else self.sandbox).address or self.name

    def open_for(self, repository: ForRepository) -> None:
        """Prepare the place for the repository, once; raises as ``Sandbox.for_repository``."""
        with self._opening:
            if self._opened is None:
                self._runtime = self._runtime or self._make_runtime(self)
                self._opened = repository(self.sandbox, self._runtime), self._runtime

    def runs_on(self, runtime: Runtime) -> Runtime:
        """See ``Sandbox``; uses this place's own runtime instead of ``runtime``."""
        assert self._opened is not None
        place, own = self._opened
        return place.runs_on(own)

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[WorkerServer]:
        """See ``Sandbox``; uses this place's own runtime instead of ``runtime``."""
        assert self._opened is not None
        place, own = self._opened
        return place.acquire(store, own, idle_s)

    def prepare(
        self, order: m.OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> m.OpenJail:
        """See ``Sandbox``; the order gets the interpreter and the packages of this place."""
        assert self._opened is not None
        place, (python, packages) = self._opened
        order = m.replace(order, python=python, packages=packages)
        return place.prepare(order, server, client, deadline)


class FleetPackages:
    """The packages of one repository on all places: a ``PackageTarget``. Thread-safe.
    ``members``: returns the places of the fleet.
    ``host``: the runtime on this machine if no packages are made: an interpreter of this machine.
    """

    def __init__(self) -> None:
        self.members: Callable[[], list[Member]] = list
        self.host = Runtime("")
        self._lock = threading.Lock()
        self._request: PackageRequest | None = None
        self._made: dict[Member, PackageSet | None] = {}

    def meets(self, request: PackageRequest) -> bool:
        """Whether every place has the packages installed."""
        targets = [member.sandbox.package_target() for member in self.members()]
        return all(target is not None and target.meets(request) for target in targets)

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet | None:
        """Have all places make the packages, at the same time.

        A place that cannot be reached now makes them when a worker is placed there.
        Raises ``DependencyError``: a place cannot make the packages.
        """
        self._request = request
        members = self.members()
        calls = Calls([partial(self._make, member, request, tell) for member in members])
        calls.wait()
        for member, made in zip(members, calls.each, strict=True):
            if made.error is not None:
                if not isinstance(made.error, EnvHubError) or not may_go_elsewhere(made.error):
                    raise made.error
                member.absent = True
                WORKER.warning("%s makes no packages now: %s", member.address, made.error)
        return self._summary()

    def _summary(self) -> PackageSet | None:
        """Combine the sets of all places: the folder on this machine, if any, and all facts."""
        sets = {member.address: made for member, made in self._made.items() if made is not None}
        if not sets:
            return None
        here = next((made for made in sets.values() if made.environment is not None), None)
        each = {address: made.facts for address, made in sets.items()}
        first = next(iter(each.values()))
        facts: dict[str, Any] = first
        if any(kind != first for kind in each.values()):
            facts = {**first, "places": each}
        if here is None:
            return PackageSet("", facts)
        return PackageSet(here.packages, facts, here.python, here.environment)

    def _make(self, member: Member, request: PackageRequest, tell: Tell) -> None:
        target = member.sandbox.package_target()
        made: PackageSet | None = None
        if target is None:
            if request.always:
                raise PolicyError(
                    f"packages by {option_name('dependencies')} are for this machine, for "
                    f"containers and for servers on other hosts; {member.address} has packages of "
                    "its own"
                )
        elif request.always or not target.meets(request):
            made = target.make(request, tell)
        with self._lock:
            self._made[member] = made

    def runtime_of(self, member: Member) -> Runtime:
        """Return the runtime of a place's jails; have the place make its packages before."""
        if self._request is not None and member not in self._made:
            self._make(member, self._request, lambda line: None)
        made = self._made.get(member)
        if made is None:
            return self.host if member.sandbox.is_here else Runtime("")
        return Runtime(made.python, made.packages)

"""A repository's packages, on each place of a fleet as that place makes them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from envhub_sandbox.dependencies.packages import PackageSet, Tell
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import EnvHubError, PolicyError
from envhub_sandbox.sandboxes.fleet.member import Member
from envhub_sandbox.sandboxes.fleet.refusals import may_go_elsewhere
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.threads import Calls
from envhub_worker.protocol.runtime import Runtime


class FleetPackages:
    """The packages of one repository on all places: a ``PackageTarget``. Thread-safe.

    Attributes:
        members: The places that there are now.
        host: What runs the repository where no packages are made: an interpreter of this machine.
    """

    def __init__(self) -> None:
        self.members: Callable[[], list[Member]] = list
        self.host = Runtime("")
        self._lock = threading.Lock()
        self._request: PackageRequest | None = None
        self._made: dict[Member, PackageSet | None] = {}

    def meets(self, request: PackageRequest) -> bool:
        """Whether what is installed there is enough, on every place."""
        targets = [member.sandbox.package_target() for member in self.members()]
        return all(target is not None and target.meets(request) for target in targets)

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet | None:
        """Have every place make them, at the same time.

        A place that cannot be reached now makes them when a worker is placed there.

        Raises:
            DependencyError: One of them cannot make any; the text says which.
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
        """What is said of them: the folder of this machine, if there is one, and all facts."""
        sets = {member.address: made for member, made in self._made.items() if made is not None}
        if not sets:
            return None
        here = next((made for made in sets.values() if made.environment is not None), None)
        each = {address: made.facts for address, made in sets.items()}
        first = next(iter(each.values()))
        facts: dict[str, Any] = first
        if any(one != first for one in each.values()):
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
        """What a place's jails run on; packages are made there first, if it has not made them."""
        if self._request is not None and member not in self._made:
            self._make(member, self._request, lambda line: None)
        made = self._made.get(member)
        if made is None:
            return self.host if member.sandbox.is_here else Runtime("")
        return Runtime(made.python, made.packages)

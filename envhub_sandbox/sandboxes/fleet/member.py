"""One place of a fleet, as it is for one repository."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.runtime import OWN, Runtime


@dataclass(frozen=True)
class ForRepository:
    """What ``Sandbox.for_repository`` is called with."""

    snapshot: Path
    policy: Policy
    assets: tuple[Path, ...]


class Member(Sandbox):
    """A place of a fleet.

    Its packages may be others than those of the other places: each has an interpreter of its own.

    Args:
        sandbox: The place as it was named.
        runtime: Makes what its jails run on, once, and is called before anything else.

    Attributes:
        sandbox: Likewise.
        weight: How often it is in the list.
        absent: Whether it did not answer when packages were to be made there, or had no room.
    """

    def __init__(self, sandbox: Sandbox, runtime: Callable[[Member], Runtime]) -> None:
        self.sandbox = sandbox
        self.name, self.retry_s = sandbox.name, sandbox.retry_s
        self.weight = 1
        self.absent = False
        self._opening = threading.RLock()  # interruption.md, rule 12
        self._make_runtime = runtime
        self._runtime: Runtime | None = None
        self._place: Sandbox | None = None

    @property
    def is_open(self) -> bool:
        """Whether ``open_for`` has made its place."""
        return self._place is not None

    @property
    def address(self) -> str:
        """See ``Sandbox``."""
        return (self._place or self.sandbox).address or self.name

    def open_for(self, repository: ForRepository) -> None:
        """Make the place of one repository, once; raises as ``Sandbox.for_repository`` does."""
        with self._opening:
            if self._place is None:
                if self._runtime is None:
                    self._runtime = self._make_runtime(self)
                given = repository.snapshot, repository.policy, self._runtime, repository.assets
                self._place = self.sandbox.for_repository(*given)

    def runs_on(self, runtime: Runtime) -> Runtime:
        """See ``Sandbox``; ``runtime`` is its own."""
        assert self._place is not None
        assert self._runtime is not None
        return self._place.runs_on(self._runtime)

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[WorkerServer]:
        """See ``Sandbox``; ``runtime`` is its own."""
        assert self._place is not None
        assert self._runtime is not None
        return self._place.acquire(store, self._runtime, idle_s)

    def prepare(
        self, order: m.OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> m.OpenJail:
        """See ``Sandbox``; with the interpreter and the packages of this place."""
        assert self._place is not None
        assert self._runtime is not None
        python, packages = self._runtime
        order = m.replace(order, python=python, packages=packages)
        return self._place.prepare(order, server, client, deadline)

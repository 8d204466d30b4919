"""A warm worker server, to spawn confined workers from."""

from __future__ import annotations

from time import perf_counter
from typing import Any

from benchmarks.load import Patience
from envhub_sandbox import make_env
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import open_jail
from tests.support import inside

_LONG_S = 60.0


class Warm:
    """Keeps one environment running, so that server and zygote are up.

    Args:
        reference: A repository.
        patience: Waits for others to leave the machine alone, before each.

    Attributes:
        layers: What confines the workers.
    """

    def __init__(self, reference: str, patience: Patience) -> None:
        self._reference = reference
        self._patience = patience
        self._suites = make_env(reference)
        self._suites.env.reset(seed=0)
        self._launcher: Any = inside.launcher(self._suites.env)
        self._server = inside.server(self._suites.env)
        report = self._suites.env.sandbox.report()
        self.layers = [layer["layer"] for layer in report if layer["enforced"]]

    def __enter__(self) -> Warm:
        return self

    def __exit__(self, *_: object) -> None:
        self._suites.close()

    def spawn(self) -> float:
        """Milliseconds until a worker is confined, has tried its denials and reports."""
        limits, server = self._launcher.repository.wire_limits, self._server
        client = WorkerConnection(server.endpoint, server.process_fd, limits)
        client.hello(Deadline(_LONG_S))
        self._patience.wait()
        order = inside.order(self._launcher)
        start = perf_counter()
        jail = open_jail(client, order, limits, Deadline(_LONG_S))
        taken = (perf_counter() - start) * 1000
        jail.close(Deadline(_LONG_S))
        return round(taken, 3)

    def ready(self) -> float:
        """Milliseconds for ``make_env`` and the first ``reset``."""
        self._patience.wait()
        start = perf_counter()
        suites = make_env(self._reference)
        suites.env.reset(seed=0)
        taken = (perf_counter() - start) * 1000
        suites.close()
        return round(taken, 3)

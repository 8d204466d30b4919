"""What every sandbox gives: a worker server that can be reached, and ended for certain."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol


class WorkerServer(Protocol):
    """A running worker server.

    Attributes:
        endpoint: Its ZeroMQ endpoint.
        fd_path: The socket that takes descriptors, or None where memory cannot be shared.
        process_fd: A descriptor that becomes readable when it ends.
    """

    @property
    def endpoint(self) -> str: ...  # noqa: D102
    @property
    def fd_path(self) -> str | None: ...  # noqa: D102
    @property
    def process_fd(self) -> int: ...  # noqa: D102


class Sandbox(Protocol):
    """A place for workers. Servers are shared: every ``acquire`` has its ``release``."""

    name: str

    def acquire(self, store: Path) -> WorkerServer:
        """A server that may show snapshots below ``store`` to jails.

        Raises:
            SandboxUnavailableError: There is no such place here.
            WorkerStartupError: The server did not come up.
        """

    def release(self, server: WorkerServer) -> None:
        """Give a server back; the last one who does ends it."""

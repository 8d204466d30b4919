"""What every sandbox gives: a worker server that can be reached, and ended for certain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from envhub_worker.protocol.runtime import OWN, Runtime

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.pipeline import PackageTarget
    from envhub_sandbox.policy import Policy
    from envhub_sandbox.transport.connection import WorkerClient
    from envhub_sandbox.transport.deadline import Deadline
    from envhub_sandbox.transport.tcp import Far


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


class ServerUse(Protocol):
    """One use of a server, which is given back, or ends when nobody has it any more.

    Attributes:
        shared: The server.
        live: Whether it has not been given back.
    """

    @property
    def shared(self) -> WorkerServer: ...  # noqa: D102
    @property
    def live(self) -> bool: ...  # noqa: D102

    def release(self) -> None:
        """Give it back; the last one who does gives the server up. Idempotent.

        What a Ctrl-C interrupts is to be called again.
        """


class Sandbox(Protocol):
    """A place for workers. Servers are shared: each ``acquire`` is a use of one."""

    name: str

    def acquire(self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0) -> ServerUse:
        """Use a server that may show snapshots below ``store`` to jails.

        Args:
            store: The folder.
            runtime: What its first jail runs on. A hint: others may run on something else.
            idle_s: For how long it may be kept for whoever asks next, where this use is its last;
                0 ends it at once, None keeps it for as long as this process lives.

        Raises:
            SandboxUnavailableError: There is no such place here.
            WorkerStartupError: The server did not come up.
        """


@runtime_checkable
class EnclosedServer(WorkerServer, Protocol):
    """A server that is itself confined, with all of its jails: in a container.

    Attributes:
        layers: What holds around it, one mapping a layer: ``layer``, ``enforced``, ``detail``.
        profile: The profile of its jails, chosen among what can be had in there.
        snapshot: Where its jails find the repository's files.
        python: The interpreter of its jails; empty for the server's own.
        packages: What it calls the packages that were made for the repository; empty for those
            of the interpreter.
    """

    @property
    def layers(self) -> Sequence[Mapping[str, Any]]: ...  # noqa: D102
    @property
    def profile(self) -> str: ...  # noqa: D102
    @property
    def snapshot(self) -> str: ...  # noqa: D102
    @property
    def python(self) -> str: ...  # noqa: D102
    @property
    def packages(self) -> str: ...  # noqa: D102


@runtime_checkable
class FarServer(EnclosedServer, Protocol):
    """A server on another host, which sees no file of this one.

    Attributes:
        far: Its key and ours.
    """

    @property
    def far(self) -> Far: ...  # noqa: D102

    def bring(self, client: WorkerClient, deadline: Deadline) -> None:
        """Bring the repository's files there; ``snapshot`` then says where they are.

        Raises:
            WorkerError: The server does not take them.
        """


class RepositorySandbox(Sandbox, Protocol):
    """A sandbox for one repository.

    Attributes:
        interpreter: What runs the repository; a remembered manifest holds for this only.
    """

    interpreter: str


@runtime_checkable
class Crowded(Protocol):
    """A place that others use, too, and that may have no room at present.

    Attributes:
        retry_s: For how long to wait for it.
    """

    retry_s: float


@runtime_checkable
class PerRepository(Protocol):
    """A place where each repository gets a server of its own, which sees no other's files."""

    def for_repository(self, snapshot: Path, policy: Policy, runtime: Runtime) -> RepositorySandbox:
        """The sandbox for the files in ``snapshot``. Starts nothing.

        Args:
            snapshot: The verified files.
            policy: What the jails may do.
            runtime: The interpreter that the caller named, or none, and the repository's packages.

        Raises:
            PolicyError: The place cannot permit what the policy does.
            SandboxUnavailableError: There is no such place here.
        """


@runtime_checkable
class PackageSource(Protocol):
    """A place that has packages of a repository's own."""

    def package_target(self) -> PackageTarget:
        """Makes them for what runs there; the place is asked only once it has to make some."""

"""The base class of sandboxes, in which workers run, with the methods that most of them share.

Also the rules for a server without room: whether to try another server, and whether to retry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, TypeVar

from envhub_sandbox.errors import (
    EnvHubError,
    SandboxUnavailableError,
    ServerBusyError,
    WorkerDiedError,
    WorkerStartupError,
    WorkerTimeoutError,
)
from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import UnreachableError
from envhub_worker.protocol.messages.server import DRAINING
from envhub_worker.protocol.runtime import OWN, Runtime

if TYPE_CHECKING:
    from envhub_sandbox.settings.policy import Policy
    from envhub_sandbox.transport.connection import WorkerConnection
    from envhub_worker.protocol.messages import OpenJail

T = TypeVar("T")
_SOON_S = 0.1
_SLICE_S = 0.1
_AGAIN_S = 1.0


def is_list(text: str) -> bool:
    """Whether a text names several sandboxes."""
    return "," in text


class Sandbox:
    """A kind of place where workers run. A subclass overrides ``acquire`` or ``for_repository``.

    Attributes:
        name: Its name in errors.
        is_here: Whether jails run on this machine and see its files.
        retry_s: How long to wait for room on a server that others use, too.
    """

    name: str
    is_here: bool = False
    retry_s: float = 0.0

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> Sandbox:
        """The sandbox for one repository, whose server sees no other files. Starts nothing.
        ``runtime``: the interpreter that the caller named, if any, and the repository's packages.
        ``assets``: verified files of further repositories that its jails can read.
        Raises ``PolicyError``: the sandbox cannot permit what the policy permits;
        ``SandboxUnavailableError``: this machine lacks this sandbox.
        """
        return self

    def workers(self, num_workers: int | None) -> Sequence[Sandbox]:
        """The sandboxes of an environment's workers, each with a jail of its own. Most sandboxes
        have one jail with ``num_workers`` processes."""
        return [self]

    @property
    def address(self) -> str:
        """Its address if it has one, else its name."""
        return self.name

    def note_interpreter(self, runtime: Runtime) -> None:
        """Note the interpreter of this machine that the caller named, before any other call."""

    def candidates(self) -> Iterator[Sandbox]:
        """The sandboxes in which a jail may be opened, in the order to try them."""
        yield self

    def runs_on(self, runtime: Runtime) -> Runtime:
        """The interpreter and packages there; a remembered manifest holds only for these."""
        return runtime

    def package_target(self) -> Any:
        """The ``PackageTarget`` of ``extras.packages`` that makes a repository's own packages for
        this sandbox; None if there is none.

        It asks the server nothing before it has to make packages.
        """
        return None

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[WorkerServer]:
        """Use a shared server, whose jails may read snapshots below ``store``.
        ``runtime``: a hint on the interpreter and packages of its first jail.
        ``idle_s``: how long to keep the server after its last use; None while this process lives.
        Raises ``SandboxUnavailableError``: this machine lacks this sandbox;
        ``WorkerStartupError``: the server did not start.
        """
        raise SandboxUnavailableError(f"{self.name}: a server is started for one repository only")

    def prepare(
        self, order: OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> OpenJail:
        """Convert the order for a jail to the terms of this sandbox's server.
        ``order``: the order in terms of this machine.
        ``deadline``: bounds uploads to the server.
        Raises ``WorkerError``: the server refuses.
        """
        return order


def may_go_elsewhere(error: EnvHubError) -> bool:
    """Whether to try another server, since this one has no room or cannot be reached.

    An error of the repository would be the same elsewhere, and a refused key has to be reported.
    """
    if isinstance(error, WorkerDiedError):
        return error.reason in ("connection", "server")
    if isinstance(error, WorkerTimeoutError):
        return error.request is None
    return isinstance(error, (ServerBusyError, UnreachableError, WorkerStartupError))


def worst_of(failures: Sequence[EnvHubError]) -> EnvHubError:
    """The error for a worker that no server takes: preferably a temporary one, with all texts.

    ``failures``: the error of each try, in order; at least one.
    """
    busy = (failure for failure in failures if isinstance(failure, ServerBusyError))
    error = next(busy, failures[0])
    others = [str(failure).partition("\n")[0] for failure in failures if failure is not error]
    if others and error.args:
        more = "\n".join(["The other places of the fleet:", *others])
        error.args = (f"{error.args[0]}\n{more}", *error.args[1:])
    return error


def retry_while_busy(
    ask: Callable[[], T],
    retry_s: float,
    deadline: Deadline,
    label: str,
    refusal: EnvHubError | None = None,
) -> T:
    """Ask again while the server has no room.

    A server serves clients that ask again in their order, so the second try comes soon, to get a
    place in the queue. The time in the queue does not count against the ``deadline``.
    ``refusal``: the error of an earlier try.
    Raises ``ServerBusyError``: there was no room within ``retry_s``.
    """
    until, pause_s = monotonic() + retry_s, _SOON_S
    ends = refusal is not None and (is_draining(refusal) or is_unanswered(refusal))
    while True:
        try:
            return ask()
        except (ServerBusyError, WorkerDiedError, UnreachableError) as error:
            left_s = until - monotonic()
            ends = ends or is_draining(error)
            worth_it = isinstance(error, ServerBusyError) or (ends and is_unanswered(error))
            if left_s <= 0 or deadline.unasked or not worth_it:
                raise
            if pause_s == _SOON_S:
                WORKER.warning("%s: %s; waiting for up to %.0f s", label, error, left_s)
            _pause(min(pause_s, left_s), deadline)
            pause_s = max(getattr(error, "retry_s", _AGAIN_S), _SLICE_S * 2)


def is_draining(error: EnvHubError) -> bool:
    """Whether the server is shutting down, so that another may replace it."""
    return isinstance(error, ServerBusyError) and error.quota == DRAINING


def is_unanswered(error: EnvHubError) -> bool:
    """Whether there was no answer, as while one server replaces another."""
    if isinstance(error, WorkerDiedError):
        return error.reason == "connection"
    return isinstance(error, UnreachableError)


def _pause(pause_s: float, deadline: Deadline) -> None:
    until = monotonic() + pause_s
    while not deadline.unasked and (left_s := until - monotonic()) > 0:
        sleep(min(left_s, _SLICE_S))
    deadline.postpone(pause_s)

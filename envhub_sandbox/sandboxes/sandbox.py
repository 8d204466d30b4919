"""A place for workers: what ``make_env`` asks of each, with what most of them answer.

Also what is done where one has no room: whether another is tried, and whether to ask it again.
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
    """Whether a text names several places."""
    return "," in text


class Sandbox:
    """A place for workers. Each overrides ``acquire`` or ``for_repository``, and what differs.

    Attributes:
        name: How errors call it.
        is_here: Whether jails run on this machine and see its files.
        retry_s: How long to wait for room in a place that is shared with others.
    """

    name: str
    is_here: bool = False
    retry_s: float = 0.0

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> Sandbox:
        """The place for one repository, whose server sees no other's files; starts nothing.
        ``runtime``: the interpreter that the caller named, if any, and the repository's packages.
        ``assets``: verified files of further repositories that its jails see.
        Raises ``PolicyError``: the place cannot permit what the policy does;
        ``SandboxUnavailableError``: there is no such place here.
        """
        return self

    def workers(self, num_workers: int | None) -> Sequence[Sandbox]:
        """The places of an environment's workers, each with a jail of its own. In most places it
        is one jail with ``num_workers`` processes."""
        return [self]

    @property
    def address(self) -> str:
        """Where it is, as far as that says more than its name."""
        return self.name

    def note_interpreter(self, runtime: Runtime) -> None:
        """Note the interpreter of this machine that the caller named, before all else."""

    def candidates(self) -> Iterator[Sandbox]:
        """The places where a jail may be opened, in the order in which to try them."""
        yield self

    def runs_on(self, runtime: Runtime) -> Runtime:
        """What runs the repository there; a remembered manifest holds for this only."""
        return runtime

    def package_target(self) -> Any:
        """A ``PackageTarget`` of ``extras.packages``, which makes a repository's own packages for
        what runs there; None where nothing can.

        Asks the place nothing before it has to make some.
        """
        return None

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[WorkerServer]:
        """Use a server, which is shared, that may show snapshots below ``store`` to jails.
        ``runtime``: a hint on what its first jail runs on.
        ``idle_s``: how long to keep the server after its last use; None while this process lives.
        Raises ``SandboxUnavailableError``: there is no such place here; ``WorkerStartupError``: the
        server did not come up.
        """
        raise SandboxUnavailableError(f"{self.name}: a server is started for one repository only")

    def prepare(
        self, order: OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> OpenJail:
        """The order for a jail as a server of this place understands it.
        ``order``: in terms of this machine.
        ``deadline``: for what has to be brought there first.
        Raises ``WorkerError``: the server does not take it.
        """
        return order


def may_go_elsewhere(error: EnvHubError) -> bool:
    """Whether to try another place, since this one has no room or cannot be reached.

    A repository would fail elsewhere too, and a refused key is a mistake to report.
    """
    if isinstance(error, WorkerDiedError):
        return error.reason in ("connection", "server")
    if isinstance(error, WorkerTimeoutError):
        return error.request is None
    return isinstance(error, (ServerBusyError, UnreachableError, WorkerStartupError))


def worst_of(failures: Sequence[EnvHubError]) -> EnvHubError:
    """The error for a worker that no place takes: one that may pass first; the text has all.

    ``failures``: at least one, in the order of the tries.
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
    """Ask again as long as there is no room.

    A server serves those who ask again in their order, so the second try comes soon, to get a place
    in the line. The time in the line does not count against the ``deadline``.
    ``refusal``: the answer to an earlier try.
    Raises ``ServerBusyError``: there was no room in all that time.
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
    """Whether there was no answer, as in the moment between two servers."""
    if isinstance(error, WorkerDiedError):
        return error.reason == "connection"
    return isinstance(error, UnreachableError)


def _pause(pause_s: float, deadline: Deadline) -> None:
    until = monotonic() + pause_s
    while not deadline.unasked and (left_s := until - monotonic()) > 0:
        sleep(min(left_s, _SLICE_S))
    deadline.postpone(pause_s)

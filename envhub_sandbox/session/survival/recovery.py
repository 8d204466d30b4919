"""What becomes of a request when processes die under it: it fails, or they are brought back.

With ``restart="transparent"`` a death is survived: the dead shards come back in fresh runners, and
the others go on. Otherwise it is told. What the fresh are seeded with is in ``seeds``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from envhub_sandbox.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.log import WORKER
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.survival.failures import Failures
from envhub_sandbox.session.survival.restart_policy import Restarts
from envhub_sandbox.session.survival.revived_rows import marked, truncated
from envhub_sandbox.session.survival.seeds import SeedBook, Settings, resets
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_sandbox.transport.jail import RunnersDiedError
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import typed
from envhub_sandbox.transport.request import Request
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.untrusted import UNTRUSTED

Requests = Callable[[Lane, int], list[m.Message]]
"""What a shard's fresh runner is asked, one after the other."""


class Recovery(Protocol):
    """Learns what is asked of an environment, and stands in for those who died of it."""

    def started(self) -> None:
        """There is a fresh jail: whatever was asked of another is of no concern."""

    def sent(self, request: Request) -> None:
        """A request has gone out."""

    def answered(self) -> None:
        """Every shard has answered it, and none has raised."""

    def survivable(self, error: WorkerError) -> RunnersDiedError | None:
        """The deaths, where the end of a jail can be survived."""

    def steps(self, deaths: RunnersDiedError) -> dict[int, m.StepDone]:
        """The rows of the dead shards in the step that they died of, from fresh runners.

        Raises:
            WorkerError: They died again, took too long, or have died too often.
            RemoteEnvError: The repository raised this time.
        """

    def resets(self, deaths: RunnersDiedError) -> dict[int, m.ResetDone]:
        """The same for a reset."""


class Fail:
    """A death is told. Whoever resets afterwards may get a fresh jail: see ``Restarts``."""

    def started(self) -> None:
        """Nothing is remembered."""

    def sent(self, request: Request) -> None:
        """Nothing is remembered."""

    def answered(self) -> None:
        """Nothing is remembered."""

    def survivable(self, error: WorkerError) -> RunnersDiedError | None:
        """None is."""
        return None

    def steps(self, deaths: RunnersDiedError) -> dict[int, m.StepDone]:
        """There are no others: a jail ends with any of its runners."""
        raise deaths.first

    def resets(self, deaths: RunnersDiedError) -> dict[int, m.ResetDone]:
        """As ``steps``."""
        raise deaths.first


class Revive:
    """The dead come back in fresh runners, seeded anew, with the attributes that were set.

    Args:
        lease: The environment's jail.
        results: Its manifest and slices.
        restarts: How often it may be done, and how soon.
        failures: Make the errors.
    """

    def __init__(
        self, lease: Lease, results: Results, restarts: Restarts, failures: Failures
    ) -> None:
        manifest = results.manifest
        self._lease = lease
        self._num_envs = manifest.num_envs
        self._bounds = results.bounds
        self._restarts = restarts
        self._failures = failures
        self._seeds = SeedBook(manifest.num_envs, manifest.shardable)
        self._settings = Settings()
        self._setting: tuple[str, list[list[bytes]]] | None = None  # what is being set
        self._asked: Sequence[m.Message] = ()

    def started(self) -> None:
        """See ``Recovery``."""
        self._settings.clear()

    def sent(self, request: Request) -> None:
        """See ``Recovery``."""
        self._asked = messages = request.messages
        self._setting = None
        for message, (start, _) in zip(messages, self._bounds, strict=True):
            if isinstance(message, m.Reset):
                self._seeds.remember(message, start)
        if isinstance(messages[0], m.SetAttr):
            self._setting = messages[0].name, request.kept()

    def answered(self) -> None:
        """See ``Recovery``."""
        if self._setting is not None:
            self._settings.remember(*self._setting)
            self._setting = None

    def survivable(self, error: WorkerError) -> RunnersDiedError | None:
        """All shards have died with the jail."""
        if not isinstance(error, WorkerDiedError):  # a sibling has given the jail up
            error = WorkerDiedError(str(error), reason="killed")
        shards = range(len(self._bounds))
        nobody: list[m.Message | None] = [None for _ in shards]
        return RunnersDiedError(nobody, dict.fromkeys(shards, error), jail_gone=True)

    def steps(self, deaths: RunnersDiedError) -> dict[int, m.StepDone]:
        """See ``Recovery``. Trust: input from the worker."""
        fresh = self._bring_back(deaths, "step", self._revivals)
        with UNTRUSTED:
            return {
                index: truncated(typed(reply, m.StepDone), self._size(index))
                for index, reply in fresh.items()
            }

    def resets(self, deaths: RunnersDiedError) -> dict[int, m.ResetDone]:
        """See ``Recovery``. Trust: input from the worker."""
        fresh = self._bring_back(deaths, "reset", self._resets)
        done = {index: typed(reply, m.ResetDone) for index, reply in fresh.items()}
        with UNTRUSTED:
            return {
                index: m.replace(one, info=marked(one.info, self._size(index)))
                for index, one in done.items()
            }

    def _bring_back(
        self, deaths: RunnersDiedError, operation: str, requests: Requests
    ) -> dict[int, m.Message]:
        """What the fresh runners answer to the last of their requests."""
        if any(death.reason == "protocol" for death in deaths.deaths.values()):
            raise deaths.first  # whoever breaks the rules is given no second chance
        try:
            self._restarts.spend(operation)
        except WorkerDiedError as spent:
            raise deaths.first from spent
        self._tell(deaths)
        dead = sorted(deaths.deaths)
        timeouts = self._lease.repository.timeouts
        deadline = StartupDeadline(timeouts.startup_s)
        if deaths.jail_gone:
            self._lease.replace(deadline)
        else:
            self._lease.rebuild(dead, deadline)
        lane, deadline_of_reset = self._lease.lane, Deadline(timeouts.reset_s)
        assert lane is not None
        try:
            self._set_again(lane, dead, deadline_of_reset)
            return _ask_anew(lane, dead, requests, deadline_of_reset)
        except WorkerTimeoutError as error:
            raise self._failures.late("reset", deadline_of_reset) from error

    def _tell(self, deaths: RunnersDiedError) -> None:
        """Log a death that the caller sees in the infos only."""
        rows = [row for index in sorted(deaths.deaths) for row in range(*self._bounds[index])]
        why, label = str(deaths.first).partition("\n")[0], self._lease.repository.label
        WORKER.info("%s: %s; sub-environments %s begin anew in fresh processes", label, why, rows)

    def _set_again(self, lane: Lane, dead: Sequence[int], deadline: Deadline) -> None:
        """Set attributes in fresh runners; what one's setter raises is only logged."""
        for name, frames in self._settings.messages():
            asked: list[tuple[int, list[Buffer]]] = [
                (lane.runners[index], [*frames[index]]) for index in dead
            ]
            replies = lane.jail.ask("set_attr", asked, deadline)
            if any(isinstance(reply, m.Raised) for reply in replies):
                label = self._lease.repository.label
                WORKER.warning("%s: %r could not be set again", label, name)
            for reply in replies:
                if not isinstance(reply, m.Raised):
                    typed(reply, m.Value)

    def _revivals(self, lane: Lane, index: int) -> list[m.Message]:
        return [m.Revive(lane.number, self._derived(index))]

    def _resets(self, lane: Lane, index: int) -> list[m.Message]:
        reset = self._asked[index]
        assert isinstance(reset, m.Reset)
        return resets(reset, self._derived(index))

    def _derived(self, index: int) -> Any:
        return self._seeds.derived(self._bounds[index], self._restarts.count)

    def _size(self, index: int) -> int:
        start, stop = self._bounds[index]
        return stop - start


def _ask_anew(
    lane: Lane, dead: Sequence[int], requests: Requests, deadline: Deadline
) -> dict[int, m.Message]:
    replies: list[m.Message] = []
    for messages in zip(*(requests(lane, index) for index in dead), strict=True):
        asked = [(lane.runners[i], message) for i, message in zip(dead, messages, strict=True)]
        replies = lane.jail.exchange("reset", asked, deadline)
    return dict(zip(dead, replies, strict=True))

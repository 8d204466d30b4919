"""An environment whose processes may die or be late: how that is told, and how it is survived.

Who of the others has answered is in ``survivors``, what the fresh are asked in ``reseed``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any

from envhub_sandbox.errors import (
    EnvHubError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerTimeoutError,
)
from envhub_sandbox.log import WORKER
from envhub_sandbox.session import survivors
from envhub_sandbox.session.jail_sources import JailSource, SharedJail
from envhub_sandbox.session.launcher import LoadedJail
from envhub_sandbox.session.lease import Tenant
from envhub_sandbox.session.placement import Place
from envhub_sandbox.session.reseed import Frames, SeedBook, Settings, marked, resets, truncated
from envhub_sandbox.session.survivors import Requests
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_sandbox.transport.jail import RunnersDiedError, check, typed
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.transport.shared_memory.sharding import PaceBook
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, State
from envhub_worker.protocol.manifest import EnvManifest

MessageFor = Callable[[int, tuple[int, int]], m.Message]
"""Makes the message for a shard out of the environment's number and the shard's bounds."""

_CAUSE_S = 10.0


class Mortal(Tenant):
    """What becomes of one environment, and of its pending request, when processes of it die.

    With ``restart="transparent"`` a death is survived: the dead shards come back in fresh runners,
    and the others go on. Otherwise it is told. It is made of what a ``Tenant`` is made of.
    """

    def __init__(
        self,
        jails: JailSource,
        manifest: EnvManifest,
        bounds: Sequence[tuple[int, int]],
        paces: PaceBook,
    ) -> None:
        super().__init__(jails, manifest, bounds, paces)
        self._revives = jails.repository.policy.restart == "transparent"
        self._seeds = SeedBook(manifest.num_envs, manifest.shardable)
        self._settings = Settings()
        self._setting: tuple[str, list[Frames]] | None = None  # what is being set
        self._asked: MessageFor | None = None  # what was asked last

    def _build_in(self, loaded: LoadedJail, deadline: Deadline) -> None:
        super()._build_in(loaded, deadline)
        self._settings.clear()

    # --- how it is learnt, and told ------------------------------------------------------------

    def _see_whether_it_expired(self) -> None:
        assert self._loaded is not None
        try:
            self._loaded.jail.output("reset", Deadline(_CAUSE_S))
        except WorkerDiedError as error:
            if error.reason == "idle":
                self._moved(Event.EXPIRY)
        # of any other death the reset that follows hears as of its own

    def _late(self, operation: str, deadline: Deadline) -> WorkerTimeoutError:
        assert self._loaded is not None
        timeout_s = deadline.timeout_s
        states = self.repository.states(self._loaded)
        WORKER.info("%s: no answer to %s after %s s", self.repository.label, operation, timeout_s)
        busy = f" (its processes: {', '.join(states)})" if states else ""
        error = WorkerTimeoutError(
            f"{operation} has not finished after {timeout_s} s{busy}; reset() brings the "
            "environment back, in a fresh process if it still does not answer",
            request=operation,
            timeout_s=timeout_s,
        )
        error.worker = states
        return error

    def _expired(self, operation: str, why: str) -> WorkerDiedError:
        self._moved(Event.EXPIRY)
        self.lifecycle.request = None
        text = f"cannot {operation}: {why}, so its processes were ended; call reset() first"
        return WorkerDiedError(text, reason="idle", request=operation, detail=why)

    def _dead(self, error: EnvHubError) -> EnvHubError:
        """Write a death down; what closed an environment under its user is told as such."""
        assert self.lifecycle.request is not None
        if self.lifecycle.state is State.CLOSED:
            return self._closed(self.lifecycle.request)
        self.counters.deaths += 1
        self._moved(Event.DEATH)
        WORKER.info("%s: %s", self.repository.label, str(error).partition("\n")[0])
        kept = self._loaded is not None and self._loaded.jail.kept
        if self._loaded is not None and (kept or not isinstance(error, WorkerDiedError)):
            self._jails.end(self._loaded)  # it lives, and cannot be trusted to do what it says
        if isinstance(error, WorkerDiedError):
            self._keep_crash(error)
        return error

    def _distrust(self, error: RemoteProtocolError) -> None:
        """Its reply came, and broke a rule: it is ended, whatever else it may have to say."""
        self.counters.deaths += 1
        self.lifecycle.request = None
        self._moved(Event.DEATH)
        WORKER.info("%s: %s", self.repository.label, str(error).partition("\n")[0])
        if self._loaded is not None:
            self._jails.end(self._loaded)

    def _keep_crash(self, error: WorkerDiedError | WorkerTimeoutError) -> None:
        task = {
            "suite": self.manifest.suite,
            "task": self.manifest.task,
            "num_envs": self.manifest.num_envs,
            "shards": len(self.bounds),
            "lane": None if self._lane is None else self._lane.name,
        }
        recording, shared = self.history.recording(), isinstance(self._jails, SharedJail)
        self.repository.keep_crash(error, recording, task, self._loaded, shared=shared)

    # --- a request that is survived ------------------------------------------------------------

    def _survive_request(self, deaths: RunnersDiedError) -> list[m.Message]:
        """A reset is done in fresh runners; anything else is not repeated.

        Raises:
            WorkerDiedError: It was something else; the next step or reset brings them back.
        """
        replies = self._of_survivors(deaths)
        if self.lifecycle.request != "reset":
            self.lifecycle.request = None
            self._moved(Event.REPLY)
            raise deaths.first
        for index, reply in self._revive(deaths, self._resets).items():
            done = typed(reply, m.ResetDone)
            replies[index] = m.replace(done, info=marked(done.info, self._size(index)))
        return [reply for reply in replies if reply is not None]

    def _survive_step(self, deaths: RunnersDiedError) -> StepResult:
        """The step's results, with fresh observations in the rows of the dead."""
        started = perf_counter_ns()
        parts = self._of_survivors(deaths)
        for index, reply in self._revive(deaths, self._revivals).items():
            parts[index] = truncated(typed(reply, m.StepDone), self._size(index))
        self.counters.stepped(perf_counter_ns() - started)
        return self.results.step([typed(part, m.StepDone) for part in parts if part is not None])

    def _of_survivors(self, deaths: RunnersDiedError) -> list[m.Message | None]:
        """What the others answered; None where nobody did.

        Raises:
            RemoteEnvError: One of them raised. The next request meets the deaths.
        """
        try:
            for reply in deaths.replies:
                if reply is not None:
                    check(reply)
        except EnvHubError:
            self.lifecycle.request = None
            self._moved(Event.REPLY)
            raise
        return deaths.replies

    # --- the fresh in place of the dead --------------------------------------------------------

    def _revive(self, deaths: RunnersDiedError, requests: Requests) -> dict[int, m.Message]:
        """Bring dead shards back; returns what their fresh runners answer to the last request."""
        self._moved(Event.LOSS)
        self._keep_crash(deaths.first)
        try:
            replies = self._bring_back(deaths, requests)
        except WorkerTimeoutError as error:
            if self.lifecycle.state is State.CLOSED:
                raise self._dead(error) from error
            self.lifecycle.request = None  # nobody knows how far it came: a reset starts afresh
            self._moved(Event.TIMEOUT)
            raise
        except EnvHubError as error:
            raise self._dead(error) from (error.__cause__ or deaths.first)
        except BaseException as error:
            if self.lifecycle.state is State.CLOSED and isinstance(error, Exception):
                raise self._dead(WorkerDiedError("")) from error
            self.lifecycle.request = None
            self._moved(Event.INTERRUPT)
            raise
        self.lifecycle.request = None
        self.counters.deaths += len(replies)
        self.history.revived()
        self._moved(Event.REVIVAL)
        return replies

    def _bring_back(self, deaths: RunnersDiedError, requests: Requests) -> dict[int, m.Message]:
        assert self.lifecycle.request is not None
        if any(death.reason == "protocol" for death in deaths.deaths.values()):
            raise deaths.first  # whoever breaks the rules is given no second chance
        try:
            self._restarts.spend(self.lifecycle.request)
        except WorkerDiedError as spent:
            raise deaths.first from spent
        dead = sorted(deaths.deaths)
        deadline = self._startup = StartupDeadline(self.repository.timeouts.startup_s)
        try:
            with self.repository.starting(deadline):
                self._rebuild(None if deaths.jail_gone else dead, deadline)
        finally:
            self._startup = None
            self._let_server_go()
        return self._ask_anew(dead, requests)

    def _rebuild(self, dead: list[int] | None, deadline: Deadline) -> None:
        """Some shards in fresh runners of the same jail, or None: all of them in a fresh jail."""
        if dead is None:
            self._leave()
            self._move_into(self._jails.take(deadline), deadline)
        else:
            assert self._loaded is not None
            assert self._lane is not None
            self._builder.rebuild(Place(self._loaded, self._lane), dead, deadline)

    def _ask_anew(self, dead: list[int], requests: Requests) -> dict[int, m.Message]:
        assert self._lane is not None
        deadline = Deadline(self.repository.timeouts.reset_s)
        try:
            for name in survivors.set_again(self._lane, dead, self._settings.messages(), deadline):
                WORKER.warning("%s: %r could not be set again", self.repository.label, name)
            return survivors.ask_anew(self._lane, dead, requests, deadline)
        except WorkerTimeoutError as error:
            raise self._late("reset", deadline) from error

    def _remember(self, message_for: MessageFor, message: m.Message, sent: list[Frames]) -> None:
        """What was asked may have to be asked again, and fresh runners need seeds.

        Args:
            message_for: Makes it again.
            message: What the first shard was asked.
            sent: What was sent to each.
        """
        self._asked = message_for
        self._setting = None
        if self._revives and isinstance(message, m.Reset):
            self._seeds.remember(self._reset_of((0, self.manifest.num_envs)))
        if self._revives and isinstance(message, m.SetAttr):
            # copies: large values are sent from where they lie, and may change
            self._setting = message.name, [list(map(bytes, frames)) for frames in sent]

    def _has_set(self) -> None:
        """Every sub-environment has answered: fresh ones are told what was set, if it was."""
        if self._setting is not None:
            self._settings.remember(*self._setting)
            self._setting = None

    def _revivals(self, index: int) -> list[m.Message]:
        return [m.Revive(self._env_number, self._derived(index))]

    def _resets(self, index: int) -> list[m.Message]:
        return resets(self._reset_of(self.bounds[index]), self._derived(index))

    def _derived(self, index: int) -> Any:
        return self._seeds.derived(self.bounds[index], self._restarts.count)

    def _reset_of(self, bounds: tuple[int, int]) -> m.Reset:
        assert self._asked is not None
        reset = self._asked(self._env_number, bounds)
        assert isinstance(reset, m.Reset)
        return reset

    @property
    def _env_number(self) -> int:
        assert self._lane is not None
        return self._lane.number

    def _size(self, index: int) -> int:
        start, stop = self.bounds[index]
        return stop - start

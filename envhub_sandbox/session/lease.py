"""An environment's hold on a jail: taken, built in, given up for another, and given back.

It does not know the requests to the environment, nor why a jail is given up. ``AttributeCache``
answers reads of attributes after each step, which the runners watch from the second read on.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from envhub_sandbox.errors import (
    EnvHubError,
    RemoteEnvError,
    ServerBusyError,
    WorkerDiedError,
    WorkerError,
)
from envhub_sandbox.sandboxes.pool import WorkerServer
from envhub_sandbox.sandboxes.sandbox import is_draining, is_unanswered, retry_while_busy
from envhub_sandbox.session.builder import Builder, JailSource
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.launcher import LoadedJail
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.system.platform import OwnerProcess
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_sandbox.transport.replies import UnreachableError
from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.shard_trials import LEAST_STEPS, ShardTrials
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.lifecycle import Lifecycle, State

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import AttributeAnswer
    from envhub_sandbox.transport.lane import Lane

_WITHOUT_A_JAIL = frozenset({State.EXPIRED, State.DEAD, State.FOREIGN, State.CLOSED})
"""It may not have been given back yet."""
_COLD_STEPS = 8
"""Steps that are not measured: much happens only once in them."""
_LONGEST = 30
"""A longer step, in medians, counts as this long: it was paused, not waiting for a core."""
_SUCCESSOR_S = 60.0
"""For how long a restart waits for the server that comes in the place of one that ends."""
_MOST_READ = 64
"""Names of one environment that are remembered."""
_MOST_STATES, _STATE_CHARS = 64, 40
"""Words about runners that are shown, and characters of each."""
_NEVER = 1 << 62


class Lease:
    """The jail of one environment, if it has one, and the lane to its runners.

    Used by the thread that holds the environment's lock; but a closing thread calls ``interrupt``,
    and a fork ``abandon``.

    Attributes:
        results: What the environment is expected to be, and its slices.
        loaded: The jail; None while there is none.
        lane: The way to its runners there.
        make_room: Asked to end what was started ahead, where a server has no place left.
        depart: Says that this environment does not need the server again. Idempotent.
    """

    def __init__(
        self,
        jails: JailSource,
        results: Results,
        lifecycle: Lifecycle,
        counters: Counters,
        trials: ShardTrials,
    ) -> None:
        self.repository: Repository = jails.launcher.repository
        self.lifecycle = lifecycle
        self.loaded: LoadedJail | None = None
        self.lane: Lane | None = None
        self.make_room: Callable[[], bool] = lambda: False
        self._jails = jails
        self._launcher = jails.launcher
        self.results = results
        self.counters = counters
        self._trials = trials
        self._builder = Builder(jails, results)
        # interruption.md, rule 12: none gives back what another ends
        self._ending = threading.RLock()
        self._owner = OwnerProcess()
        self._was_loaded = False
        self._startup: StartupDeadline | None = None
        self._release_server: Callable[[], None] = _nothing
        self.depart = jails.launcher.server_hold.enter()
        weakref.finalize(self, self.depart).atexit = False  # interruption.md, rule 13

    @property
    def shared(self) -> bool:
        """Whether other environments live in the same jail."""
        return self._jails.shared

    @property
    def place(self) -> str:
        """What errors call the place where its jail is, or the next one will be."""
        return self._launcher.where(self.loaded)

    def report(self) -> list[dict[str, Any]]:
        """The layers of the jail; none where there is none."""
        loaded = self.loaded  # another thread may give it back
        if loaded is None or self.lifecycle.state in _WITHOUT_A_JAIL:
            return []
        return loaded.jail.report

    def states(self) -> tuple[str, ...]:
        """What its runners are doing, one word each. Trust: text from the worker."""
        states = self.status().get("states")
        words = states[:_MOST_STATES] if isinstance(states, tuple) else ()
        return tuple(one_line(word, _STATE_CHARS) for word in words if isinstance(word, str))

    def status(self) -> dict[str, Any]:
        """What its server says of its jail: see ``Launcher.status``."""
        at = self._at()
        return {} if at is None else self._launcher.status(*at)

    def denials(self) -> tuple[str, ...] | None:
        """What its jail was denied, also where that is dead; None where it is not recorded."""
        at = self._at()
        return None if at is None else self._launcher.denials(*at)

    def note_denied(self, error: EnvHubError) -> None:
        """Put its denials into the error that ended the jail, before the jail is given back."""
        at = self._at()
        if at is not None:
            self._launcher.note_denied(error, *at)

    def _at(self) -> tuple[WorkerServer, int] | None:
        """The server, and the number of its jail there."""
        loaded = self.loaded  # another thread may give it back
        return None if loaded is None else (loaded.server, loaded.jail.number)

    def look(self, operation: str, deadline: Deadline) -> None:
        """Ask the server whether the jail lives. Raises ``WorkerDiedError``: it does not."""
        if self.loaded is not None:
            self.loaded.jail.output(operation, deadline)

    def note_lost(self) -> None:
        """Note that the connection to the server was lost."""
        loaded = self.loaded  # another thread may give it back
        if loaded is not None:
            loaded.lost = True

    def watched(self, name: str) -> AttributeAnswer | None:
        """What is known of a watched attribute, while the environment can be asked."""
        if self.lane is None or self.lifecycle.state is not State.READY:
            return None
        return self.lane.jail.watched.values(self.lane.number, name)

    def note_watched(self, name: str, values: AttributeAnswer) -> bool:
        """Keep the values of an attribute that the runners watch; whether they can be kept."""
        lane = self.lane
        return lane is not None and lane.jail.watched.note(lane.number, name, values)

    def forget_watched(self) -> None:
        """Forget watched values: a lost reply may have named attributes that changed."""
        loaded = self.loaded  # another thread may give it back
        if loaded is not None:
            loaded.jail.watched.forget()

    # --- taking a jail ---------------------------------------------------------------------------

    def acquire(self, deadline: StartupDeadline) -> None:
        """Take a jail, and build the environment in it; ``interrupt`` brings the deadline forward.
        Raises ``LoadError``: the repository failed to load, or returned something else than before;
        ``WorkerError``: the jail did not come up, died, took too long, or was given up.
        """
        self.give_back()  # of an attempt that was interrupted when all was built
        with self._starting(deadline):
            self._move_in(self._take(deadline), deadline)

    def adopt(self, loaded: LoadedJail, deadline: Deadline) -> None:
        """Use a jail that is already loaded, instead of taking one."""
        with self.repository.starting(deadline):
            self._move_in(loaded, deadline)

    def replace(self, deadline: StartupDeadline) -> None:
        """Give the jail up, and take another in the same server; raises as ``acquire`` does."""
        with self._starting(deadline):
            self.leave()
            self._move_in(self._take(deadline), deadline)

    def rebuild(self, dead: list[int], deadline: StartupDeadline) -> None:
        """Build some shards again, in fresh runners of this jail; raises as ``acquire`` does."""
        loaded, lane = self.loaded, self.lane
        assert loaded is not None
        assert lane is not None
        with self._starting(deadline):
            self._builder.rebuild(loaded, lane, dead, deadline)

    def take_apart(self, deadline: Deadline) -> None:
        """See ``Results.apart``: from now on, in the jail that there is and in each later one."""
        self.results.apart = True
        if self.lane is not None:
            self._builder.take_apart(self.lane, range(len(self.results.bounds)), deadline)

    @contextlib.contextmanager
    def _starting(self, deadline: StartupDeadline) -> Iterator[None]:
        self._startup = deadline
        try:
            with self.repository.starting(deadline):
                yield
        finally:
            self._startup = None
            self._let_server_go()

    def _take(self, deadline: Deadline) -> LoadedJail:
        try:
            return self._jails.take(deadline)
        except (WorkerError, UnreachableError) as error:
            full = _is_full(error)
            retry_s = self._patience_s(error)
            if deadline.unasked or not (full or retry_s):
                raise
            # both, whatever the first one finds: | and not "or"
            room = full and self._launcher.server_hold.settle() | self.make_room()
            if not room and not retry_s:
                raise
            refused = error
        ask = partial(self._jails.take, deadline)
        return retry_while_busy(ask, retry_s, deadline, self.repository.label, refused)

    def _patience_s(self, error: EnvHubError) -> float:
        """How long to retry. With restarts, a server that ended is replaced within a minute."""
        retry_s = self._launcher.retry_s if _is_full(error) else 0.0
        if self.repository.policy.restart == "never":
            return retry_s
        lost = self._was_loaded and is_unanswered(error)
        return max(retry_s, _SUCCESSOR_S) if lost or is_draining(error) else retry_s

    def _move_in(self, loaded: LoadedJail, deadline: Deadline) -> None:
        """Build the environment in a jail; a Ctrl-C leaves none behind: interruption.md, rule 4."""
        try:
            lane = self._builder.build(loaded, deadline)
            self.loaded, self.lane = loaded, lane
        except BaseException as error:
            try:
                self._launcher.note_denied(error, loaded.server, loaded.jail.number)
            finally:
                self._jails.give_back(loaded)
            raise
        self._was_loaded = True
        self.counters.connected(lane)
        if self.lifecycle.closed:  # only now: a close from here on sees the jail
            raise closed_during("make_env")

    # --- giving it back --------------------------------------------------------------------------

    def end(self) -> None:
        """End the jail, whatever it is doing. It is still to be given back."""
        if self.loaded is not None:
            self._jails.end(self.loaded)

    def leave(self) -> None:
        """End the jail and give it back, but keep its server for another."""
        self._let_server_go()
        self._release_server = self._launcher.hold()
        try:
            self.end()
        finally:
            self.give_back()

    def give_back(self, *, wait: bool = True) -> None:
        """Give the jail back, if there is one; see ``Launcher.close``."""
        with self._ending:
            loaded = self.loaded
            try:
                if loaded is not None:
                    self._jails.give_back(loaded, wait=wait)
                self.loaded = None  # interruption.md, rule 7: only now
            except Exception:
                self.loaded = None
                raise
            finally:
                self._close_lane()

    def close_politely(self) -> None:
        """Let the repository's ``close`` run; whatever it does, the processes end after it."""
        lane, deadline = self.lane, Deadline(self.repository.timeouts.close_s)
        if lane is None:
            return
        packed = lane.jail.pack(m.Close(lane.number))
        with contextlib.suppress(EnvHubError):
            lane.jail.ask("close", [(runner, packed) for runner in lane.runners], deadline)

    def note_steps(self) -> None:
        """Remember how long steps took, for the next use of the same commit."""
        latencies_s = self.counters.latencies_s()
        if len(latencies_s) >= LEAST_STEPS:
            latencies_s = latencies_s[_COLD_STEPS:]
            # the mean, for on a busy machine it is a few steps that wait for a core, and long; but
            # a pause counts no more than they do
            longest_s = _LONGEST * np.median(latencies_s)
            step_s = float(np.minimum(latencies_s, longest_s).mean())
            self._trials.note(self.results.manifest, self.results.bounds, step_s)

    def let_go(self, *, wait: bool = True) -> None:
        """Give back everything for good. In a fork of the owner, do nothing."""
        if not self._owner.is_here:
            return
        try:
            self.give_back(wait=wait)
        finally:
            self._let_server_go()
            self.depart()

    def interrupt(self, close: Callable[[], None]) -> bool:
        """From another thread, ``close`` the environment and end the jail that a request waits for;
        False if there is none yet: whoever takes one sees that it is closed. See interruption.md,
        rule 11.
        """
        with self._ending:
            close()
            if self._startup is not None:
                self._startup.give_up()
            self.end()
            return self.loaded is not None

    def abandon(self) -> None:
        """In a fork, close only what this process owns: interruption.md, rule 14."""
        self._ending = threading.RLock()
        self._release_server = _nothing
        self._close_lane()

    def _close_lane(self) -> None:
        lane = self.lane
        if lane is not None:
            self.counters.connected(None)
            lane.close()
            self.lane = None  # as above

    def _let_server_go(self) -> None:
        self._release_server()
        self._release_server = _nothing


def _is_full(error: EnvHubError) -> bool:
    """Whether the server has no room. Older servers send a plain ``WorkerError`` for that."""
    return isinstance(error, ServerBusyError) or type(error) is WorkerError


def closed_during(operation: str) -> WorkerDiedError:
    """The error of a request during which the environment was closed."""
    text = f"the environment was closed during {operation}"
    return WorkerDiedError(text, reason="killed", request=operation)


def _nothing() -> None:
    """Release nothing."""


# --- attributes that are watched


class _Reads:
    """The reads of one attribute.

    Attributes:
        steps: How many steps each worker had answered at the last one.
        rounds: How many came after a step, since it was last watched.
        patience: How many are needed until it is watched.
        watched: Whether it was, at the last answer.
    """

    __slots__ = ("patience", "rounds", "steps", "watched")

    def __init__(self, steps: list[int]) -> None:
        self.steps, self.rounds, self.patience, self.watched = steps, 0, 1, False


class AttributeCache:
    """The attributes of one environment that need no request. Not thread-safe.

    LeRobot's evaluation reads the task of every sub-environment after each step. Each read was a
    request, which costs as much as the step, and on another host a round trip. A watched attribute
    (``envhub_worker.runner.prefixes``) is answered from here, once a step: a caller that reads it
    twice waits for something to happen, and the environment answers.

    ``leases``: one for each worker of the environment.
    ``rows``: the slice of the sub-environments that each worker has.
    """

    def __init__(self, leases: Sequence[Lease], rows: Sequence[tuple[int, int]]) -> None:
        self._leases = leases
        self._rows = rows
        self._reads: dict[str, _Reads] = {}

    def get(self, name: str) -> AttributeAnswer | None:
        """The values, if a step was answered since the last read; None: a request is needed."""
        reads = self._reads.get(name)
        if reads is None:
            return None
        gathered: list[Any] = []
        error: RemoteEnvError | None = None
        for lease, step in zip(self._leases, reads.steps, strict=True):
            answer = lease.watched(name)
            if answer is None or lease.counters.steps == step:
                return None
            if isinstance(answer, RemoteEnvError):
                error = answer
            else:
                gathered += answer
        reads.steps = self._steps()
        return error or tuple(gathered)

    def should_watch(self, name: str) -> bool:
        """A request for it follows: whether that request is to have it watched."""
        if any(lease.lane is None for lease in self._leases):
            return False
        steps = self._steps()
        reads = self._reads.get(name)
        if reads is None:
            if len(self._reads) < _MOST_READ:
                self._reads[name] = _Reads(steps)
            return False
        if reads.watched and any(lease.watched(name) is None for lease in self._leases):
            # it has changed: with each time that it does, it takes twice as long to be watched
            reads.watched, reads.rounds, reads.patience = False, 0, 2 * reads.patience
        reads.rounds += reads.steps != steps
        reads.steps = steps
        return reads.rounds >= reads.patience

    def put(self, name: str, values: AttributeAnswer, *, watched: bool) -> None:
        """Keep the answer to a request after ``should_watch``; ``watched`` is the runners' word."""
        reads = self._reads[name]
        reads.watched = watched
        for lease, (start, stop) in zip(self._leases, self._rows, strict=True):
            own = values[start:stop] if isinstance(values, tuple) else values
            reads.watched = reads.watched and lease.note_watched(name, own)
        if not reads.watched:
            reads.patience = _NEVER

    def _steps(self) -> list[int]:
        return [lease.counters.steps for lease in self._leases]

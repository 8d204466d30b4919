"""A lease: takes a jail for an environment, builds in it, replaces it, and gives it back.

The lease does not know the requests to the environment, nor why a jail is given up.
``AttributeCache`` answers reads of attributes that the runners watch, without a request.
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
    WorkerTimeoutError,
)
from envhub_sandbox.sandboxes.pool import WorkerServer
from envhub_sandbox.sandboxes.sandbox import is_draining, is_unanswered, retry_while_busy
from envhub_sandbox.session.builder import Builder, JailSource
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.launcher import LoadedJail
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import warn_caller
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
"""The states of an environment whose jail is not usable, though perhaps not given back yet."""
_COLD_STEPS = 8
"""The number of first steps that are not measured, as they include one-time work."""
_LONGEST = 30
"""The longest time, in medians, that a step counts: a longer one was paused for another reason."""
_SUCCESSOR_S = 60.0
"""How long a restart waits for the server that replaces one that is ending."""
_MOST_READ = 64
"""The most attributes of one environment whose reads are counted."""
_MOST_STATES, _STATE_CHARS = 64, 40
"""The most words about runners to show, and the most characters of each."""
_NEVER = 1 << 62


class Lease:
    """The jail of one environment, if it has one, and the lane to its runners.

    Only the thread that holds the environment's lock uses it; but a closing thread may call
    ``interrupt``, and a fork calls ``abandon``.

    Attributes:
        results: The expected manifest of the environment, and its slices.
        loaded: The jail, or None.
        lane: The lane to the jail's runners, or None.
        make_room: Ends jails that were started ahead, when a server has no room.
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
        # interruption.md, rule 12: no thread gives a jail back while another ends it
        self._ending = threading.RLock()
        self._owner = OwnerProcess()
        self._was_loaded = False  # from then on a lost server is waited for
        self._startup: StartupDeadline | None = None  # of a start that runs now, for ``interrupt``
        self._release_server: Callable[[], None] = _nothing  # keeps the server between two jails
        self.depart = jails.launcher.server_hold.enter()
        weakref.finalize(self, self.depart).atexit = False  # interruption.md, rule 13

    @property
    def shared(self) -> bool:
        """Whether other environments live in the same jail."""
        return self._jails.shared

    @property
    def place(self) -> str:
        """The address of the jail, or of the next jail, for errors."""
        return self._launcher.where(self.loaded)

    def report(self) -> list[dict[str, Any]]:
        """The layers of confinement of the jail; empty without a jail."""
        loaded = self.loaded  # another thread may give it back
        if loaded is None or self.lifecycle.state in _WITHOUT_A_JAIL:
            return []
        return loaded.jail.report

    def states(self) -> tuple[str, ...]:
        """One word for each runner about what it is doing. Trust: text from the worker."""
        states = self.status().get("states")
        words = states[:_MOST_STATES] if isinstance(states, tuple) else ()
        return tuple(one_line(word, _STATE_CHARS) for word in words if isinstance(word, str))

    def status(self) -> dict[str, Any]:
        """What the server says about the jail, as by ``Launcher.status``; empty without a jail."""
        at = self._at()
        return {} if at is None else self._launcher.status(*at)

    def denials(self) -> tuple[str, ...] | None:
        """The denials of the jail, also of a dead one; None if they are not recorded."""
        at = self._at()
        return None if at is None else self._launcher.denials(*at)

    def note_denied(self, error: EnvHubError) -> None:
        """Add the jail's denials to the error that ended it, before the jail is given back."""
        at = self._at()
        if at is not None:
            self._launcher.note_denied(error, *at)

    def _at(self) -> tuple[WorkerServer, int] | None:
        """The jail's server and its number there; None without a jail."""
        loaded = self.loaded  # another thread may give it back
        return None if loaded is None else (loaded.server, loaded.jail.number)

    def look(self, operation: str, deadline: Deadline) -> None:
        """Ask the server whether the jail lives. Raises ``WorkerDiedError``: it does not."""
        if self.loaded is not None:
            self.loaded.jail.check(operation, deadline)

    def watched(self, name: str) -> AttributeAnswer | None:
        """The known values of a watched attribute; None if unknown or if the state is not READY."""
        if self.lane is None or self.lifecycle.state is not State.READY:
            return None
        return self.lane.jail.watched.values(self.lane.number, name)

    def take_seeded(self) -> bool:
        """Whether a reset has seeded the single spaces since the last call."""
        lane = self.lane
        return lane is not None and lane.jail.watched.take_seeded(lane.number)

    def note_watched(self, name: str, values: AttributeAnswer) -> bool:
        """Keep the values of a watched attribute; returns whether they can be kept."""
        lane = self.lane
        return lane is not None and lane.jail.watched.note(lane.number, name, values)

    def forget_watched(self) -> None:
        """Forget watched values: a lost reply may have named attributes that changed."""
        loaded = self.loaded  # another thread may give it back
        if loaded is not None:
            loaded.jail.watched.forget()

    # --- taking a jail ---------------------------------------------------------------------------

    def acquire(self, deadline: StartupDeadline) -> None:
        """Take a jail, and build the environment in it; ``interrupt`` ends the deadline early.
        Raises ``LoadError``: the repository failed to load, or returned another environment than
        before; ``WorkerError``: the jail did not start, died, took too long, or was given up.
        """
        self.give_back()  # a jail of an earlier attempt that was interrupted after it was noted
        with self._starting(deadline):
            self._move_in(self._take(deadline), deadline)

    def adopt(self, loaded: LoadedJail, deadline: Deadline) -> None:
        """Build in a jail that is loaded already, instead of taking one."""
        with self.repository.starting(deadline):
            self._move_in(loaded, deadline)

    def replace(self, deadline: StartupDeadline) -> None:
        """Replace the jail by a new one in the same server; raises as ``acquire`` does."""
        with self._starting(deadline):
            self.leave()
            self._move_in(self._take(deadline), deadline)

    def rebuild(self, dead: list[int], deadline: StartupDeadline) -> None:
        """Build dead shards again, in new runners of this jail; raises as ``acquire`` does."""
        loaded, lane = self.loaded, self.lane
        assert loaded is not None
        assert lane is not None
        with self._starting(deadline):
            self._builder.rebuild(loaded, lane, dead, deadline)

    def take_apart(self, deadline: Deadline) -> None:
        """Have infos come apart (``Results.apart``), in the present jail and in each later one."""
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
            # | and not "or": both have to run
            room = full and self._launcher.server_hold.settle() | self.make_room()
            if not room and not retry_s:
                raise
            refused = error
        ask = partial(self._jails.take, deadline)
        return retry_while_busy(ask, retry_s, deadline, self.repository.label, refused)

    def _patience_s(self, error: EnvHubError) -> float:
        """How long to retry. With restarts, wait a minute for a server that replaces another."""
        retry_s = self._launcher.retry_s if _is_full(error) else 0.0
        if self.repository.policy.restart == "never":
            return retry_s
        lost = self._was_loaded and is_unanswered(error)
        return max(retry_s, _SUCCESSOR_S) if lost or is_draining(error) else retry_s

    def _move_in(self, loaded: LoadedJail, deadline: Deadline) -> None:
        """Build the environment in a jail, and note the jail; on failure, give it back."""
        # interruption.md, rule 4: ``try`` is the first statement, and jail and lane are noted side
        # by side, so a Ctrl-C finds the jail either noted here or given back below. CLOSED is
        # checked only after that: a ``close`` from then on sees the jail and ends it.
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
        if self.lifecycle.closed:
            raise closed_during("make_env")

    # --- giving it back --------------------------------------------------------------------------

    def end(self) -> None:
        """End the jail, whatever it is doing. The caller still has to give it back."""
        if self.loaded is not None:
            self._jails.end(self.loaded)

    def leave(self) -> None:
        """End the jail and give it back, but keep its server for the next jail."""
        self._let_server_go()
        # In this order: a server without a jail may be ended, and the next jail would need another.
        self._release_server = self._launcher.hold()
        try:
            self.end()
        finally:
            self.give_back()

    def give_back(self, *, wait: bool = True) -> None:
        """Give the jail back, if there is one; ``wait`` as for ``Launcher.close``."""
        with self._ending:
            loaded = self.loaded
            try:
                if loaded is not None:
                    self._jails.give_back(loaded, wait=wait)
                self.loaded = None  # interruption.md, rule 7: only after it was given back
            except Exception:
                self.loaded = None
                raise
            finally:
                self._close_lane()

    def close_politely(self) -> None:
        """Have the repository's own ``close`` run, within ``close_s``; the runner warns if it
        raises.
        """
        lane, deadline = self.lane, Deadline(self.repository.timeouts.close_s)
        if lane is None:
            return
        packed = lane.jail.pack(m.Close(lane.number))
        try:
            lane.jail.ask("close", [(runner, packed) for runner in lane.runners], deadline)
        except WorkerTimeoutError:
            seconds = deadline.timeout_s
            longer = option_name("close_s", 2 * (seconds or 1))
            text = f"{self.repository.label}: its close was ended after {seconds} s"
            warn_caller(f"{text}; {longer} waits longer", RuntimeWarning)
        except EnvHubError:
            pass

    def note_steps(self) -> None:
        """Remember the mean time of a step, for the next use of the same commit."""
        latencies_s = self.counters.latencies_s()
        if len(latencies_s) >= LEAST_STEPS:
            latencies_s = latencies_s[_COLD_STEPS:]
            # The mean, because on a busy machine a few steps wait long for a core. A pause counts
            # no more than such a step. Not np.median, which imports numpy.ma: 10 ms.
            longest_s = _LONGEST * np.sort(latencies_s)[latencies_s.size // 2]
            step_s = float(np.minimum(latencies_s, longest_s).mean())
            self._trials.note(self.results.manifest, self.results.bounds, step_s)

    def let_go(self, *, wait: bool = True) -> None:
        """Give back jail and server for good. A fork of the owner does nothing."""
        if not self._owner.is_here:
            return
        try:
            self.give_back(wait=wait)
        finally:
            self._let_server_go()
            self.depart()

    def interrupt(self, close: Callable[[], None]) -> bool:
        """From another thread, ``close`` the environment and end the jail that a request waits for:
        interruption.md, rule 11. Returns False if there is no jail yet; the thread that takes it
        sees then that the environment is closed.
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
            self.lane = None  # interruption.md, rule 7, as above

    def _let_server_go(self) -> None:
        self._release_server()
        self._release_server = _nothing


def _is_full(error: EnvHubError) -> bool:
    """Whether the server has no room; a limit that is no quota is a plain ``WorkerError``."""
    return isinstance(error, ServerBusyError) or type(error) is WorkerError


def closed_during(operation: str) -> WorkerDiedError:
    """The error of a request during which the environment was closed."""
    text = f"the environment was closed during {operation}"
    return WorkerDiedError(text, reason="killed", request=operation)


def _nothing() -> None:
    """Release nothing: no server is kept."""


# --- watched attributes


class _Reads:
    """Counts the reads of one attribute, to decide whether to watch it.

    Attributes:
        steps: The number of steps that each worker had answered at the last read.
        rounds: The number of reads that each followed a step, since the attribute was last watched.
        patience: The number of such reads before the attribute is watched.
        watched: Whether the runners watched it at the last answer.
    """

    __slots__ = ("patience", "rounds", "steps", "watched")

    def __init__(self, steps: list[int]) -> None:
        self.steps, self.rounds, self.patience, self.watched = steps, 0, 1, False


class AttributeCache:
    """Answers reads of attributes that need no request. Not thread-safe.

    LeRobot's evaluation reads the task of every sub-environment after each step. A request for it
    costs as much as the step, and on another host a round trip. If the runners watch an attribute
    (``envhub_worker.runner.prefixes``), the cache answers its first read after each step. A second
    read goes to the environment, because such a caller may wait for the value to change.

    ``leases``: one for each worker of the environment.
    ``rows``: each worker's slice of the sub-environments.
    """

    def __init__(self, leases: Sequence[Lease], rows: Sequence[tuple[int, int]]) -> None:
        self._leases = leases
        self._rows = rows
        self._reads: dict[str, _Reads] = {}

    def get(self, name: str) -> AttributeAnswer | None:
        """The values, if a step was answered since the last read; None if a request is needed."""
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

    def take_seeded(self) -> bool:
        """Whether a reset has seeded the single spaces, in any worker, since the last call."""
        return any(lease.take_seeded() for lease in self._leases)

    def should_watch(self, name: str) -> bool:
        """Count a read that needs a request; returns whether to have the attribute watched."""
        if any(lease.lane is None for lease in self._leases):
            return False
        steps = self._steps()
        reads = self._reads.get(name)
        if reads is None:
            if len(self._reads) < _MOST_READ:
                self._reads[name] = _Reads(steps)
            return False
        if reads.watched and any(lease.watched(name) is None for lease in self._leases):
            # it has changed: each change doubles the reads that it takes to watch it again
            reads.watched, reads.rounds, reads.patience = False, 0, 2 * reads.patience
        reads.rounds += reads.steps != steps
        reads.steps = steps
        return reads.rounds >= reads.patience

    def put(self, name: str, values: AttributeAnswer, *, watched: bool) -> None:
        """Keep an answer after ``should_watch``; ``watched``: whether the runners say they do."""
        reads = self._reads[name]
        reads.watched = watched
        for lease, (start, stop) in zip(self._leases, self._rows, strict=True):
            own = values[start:stop] if isinstance(values, tuple) else values
            reads.watched = reads.watched and lease.note_watched(name, own)
        if not reads.watched:
            reads.patience = _NEVER

    def _steps(self) -> list[int]:
        return [lease.counters.steps for lease in self._leases]

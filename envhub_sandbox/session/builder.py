"""Takes a jail for an environment, and builds the environment in it.

``JailSource`` opens a jail for each task that is in use, so that closing the task frees its
processes. If ``make_env`` built all environments at once, they live in one ``SharedJail``.
``Builder`` builds a slice of the sub-environments in each runner, and opens the lane to them.
"""

from __future__ import annotations

import itertools
import threading
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

from envhub_sandbox.errors import LoadError, remote_error
from envhub_sandbox.session.launcher import ExpectedManifest, Launcher, LoadedJail
from envhub_sandbox.system import extras
from envhub_sandbox.system.platform import OwnerProcess
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import check_reply, typed_reply
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import EnvManifest, decode_env
from envhub_worker.protocol.spaces.differing import Pair, differing
from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from envhub_sandbox.transport.lane import Lane

_LONGEST = 8192
"""The most characters of an error that shows spaces."""
_numbers = itertools.count(1)


class JailSource:
    """Gives each environment a jail of its own, and takes it back.
    ``forget_manifest``: drops the remembered manifest when a jail contradicts it.
    ``expected``: the manifest that the jail is expected to return.
    ``shared``: whether several environments live in one jail.
    """

    shared = False

    def __init__(
        self,
        launcher: Launcher,
        forget_manifest: Callable[[], None],
        expected: ExpectedManifest | None = None,
    ) -> None:
        self.launcher = launcher
        self.forget_manifest = forget_manifest
        self._expected = expected

    def take(self, deadline: Deadline) -> LoadedJail:
        """Open a jail for one environment."""
        return self.launcher.open(deadline, self._expected)

    def end(self, loaded: LoadedJail) -> None:
        """End the jail now, over another connection, since a thread may wait on the jail's own."""
        self.launcher.interrupt(loaded)

    def give_back(self, loaded: LoadedJail, *, wait: bool = True) -> None:
        """Give a jail back; with ``wait``, wait until all of its processes have ended."""
        self.launcher.close(loaded, wait=wait)


class SharedJail(JailSource):
    """One jail for all environments of a repository, each with a connection of its own.

    The environments share its process, so a death or a timeout of one ends it for all. A dead
    jail is closed after its last user has left it: its server tells each of them how it ended.
    """

    shared = True

    def __init__(self, launcher: Launcher, forget_manifest: Callable[[], None]) -> None:
        super().__init__(launcher, forget_manifest)
        launcher.plays = False  # the manifest already says whether sub-environments are independent
        self._lock = threading.RLock()  # interruption.md, rule 12
        self._owner = OwnerProcess()
        self._first: LoadedJail | None = None  # whom the next environment connects to
        self._dead: list[LoadedJail] = []  # left jails with users, who may still ask how they ended
        self._users: weakref.WeakSet[LoadedJail] = weakref.WeakSet()  # connections in use

    def provide(self, loaded: LoadedJail) -> None:
        """Use a jail that is loaded already as the shared jail."""
        self._first = loaded
        # interruption.md, rule 13; if no environment ever takes the jail, none closes it
        weakref.finalize(self, self.launcher.close, loaded).atexit = False

    def take(self, deadline: Deadline) -> LoadedJail:
        """Connect to the jail; open it first if none lives."""
        with self._lock:
            if self._first is not None and not self.launcher.lives(self._first):
                self._leave_first()
            if self._first is None:
                self._first = self.launcher.open(deadline)
            connected = self.launcher.connect(self._first, deadline)
            self._users.add(connected)
            return connected

    def end(self, loaded: LoadedJail) -> None:
        """End the jail, for all environments."""
        lives = self.launcher.lives(loaded)
        if lives is not False:
            self.launcher.interrupt(loaded)
        with self._lock:
            first = self._first
            if first is not None and first.jail.number == loaded.jail.number:
                self._leave_first()
                if lives is not False:
                    self.launcher.close(first)

    def give_back(self, loaded: LoadedJail, *, wait: bool = True) -> None:
        """Close a connection to a jail; the last one also ends the jail."""
        self.launcher.disconnect(loaded)
        loaded.jail.watched.forget()  # a lost reply may have named changed attributes
        with self._lock:
            self._users.discard(loaded)
            self._close_unused()

    def close(self) -> None:
        """End a jail that was provided and never taken. A fork of its owner does nothing."""
        if not self._owner.is_here:
            return
        with self._lock:
            self._close_unused()

    def _leave_first(self) -> None:
        """Have the next user open another jail."""
        if self._first is not None:
            self._dead.append(self._first)
            self._first = None

    def _close_unused(self) -> None:
        used = {user.jail.number for user in self._users}
        for jail in [jail for jail in self._dead if jail.jail.number not in used]:
            self.launcher.close(jail)  # interruption.md, rule 7
            self._dead.remove(jail)
        if self._first is not None and self._first.jail.number not in used:
            self.launcher.close(self._first)  # as above
            self._first = None


class Builder:
    """Builds one environment, and builds it again after each restart.
    ``results``: the expected manifest of the environment, and its slices, one for each shard.
    """

    def __init__(self, jails: JailSource, results: Results) -> None:
        self._jails = jails
        self._launcher = jails.launcher
        self._repository = jails.launcher.repository
        self._results = results
        self._manifest = results.manifest
        self._bounds = results.bounds
        # a shared jail ends with the first runner that dies: only an own jail can be kept
        self._own = not jails.shared
        self._keeps = self._own and jails.launcher.repository.policy.restart == "transparent"
        self._number = next(_numbers)  # the same in every jail, so messages can be packed once

    def build(self, loaded: LoadedJail, deadline: Deadline) -> Lane:
        """Build the environment in a loaded jail; returns the lane to its runners.
        Raises ``LoadError``: ``make_env`` returned another environment than before;
        ``WorkerError``: the jail died, or took too long.
        """
        # The manifest is checked twice: first the remembered one, before any work, and again after
        # ``spread``, where further runners may have returned something else. Only then the shards
        # are built, and the lane is opened last, since it attaches to environments that exist.
        self._check_manifest(loaded)
        loaded.jail.keep(self._keeps, self._repository.timeouts.idle_s, deadline)
        runners = self._launcher.spread(loaded, len(self._bounds), deadline, self._manifest)
        self._check_manifest(loaded)
        relay = self._relay(loaded, runners)
        self._build(relay, range(len(runners)), deadline)
        return self._fast_lane(relay, loaded, deadline)

    def rebuild(
        self, loaded: LoadedJail, lane: Lane, dead: Sequence[int], deadline: Deadline
    ) -> None:
        """Build dead shards again, each in a new runner of the same jail.
        Raises ``LoadError`` or ``RemoteEnvError``: the repository failed this time;
        ``WorkerError``: the new runners died too, or took too long.
        """
        gone = [lane.runners[index] for index in dead]
        fresh = loaded.jail.replace_runners(gone, deadline)
        loaded.loaded.difference_update(gone)
        self._launcher.load(loaded, fresh, deadline, self._manifest)
        self._check_manifest(loaded)
        relay = self._relay(loaded, lane.runners)
        relay.renew(dead, fresh, deadline)
        self._build(relay, dead, deadline)
        lane.renew(dead, fresh, deadline)

    def _relay(self, loaded: LoadedJail, runners: list[int]) -> Lane:
        from envhub_sandbox.transport.lane import Lane  # sandboxes/process.py says why here

        return Lane(loaded.jail, runners, self._number, self._results)

    def _build(self, relay: Lane, shards: Sequence[int], deadline: Deadline) -> None:
        wanted = self._manifest
        builds: list[tuple[int, m.Message]] = [
            (
                relay.runners[index],
                m.Build(relay.number, wanted.suite, wanted.task, *self._bounds[index]),
            )
            for index in shards
        ]
        packed = [(runner, relay.jail.pack(message)) for runner, message in builds]
        replies = relay.jail.ask("make_env", packed, deadline)
        spaces = [_spaces(self._manifest)]
        for index, reply in zip(shards, replies, strict=True):
            if type(reply) is not m.BuildDone:
                self._refuse_differing(spaces)  # this error comes first in one process, too
            check_reply(reply)
            built = typed_reply(reply, m.BuildDone)
            spaces.append(self._check_built(built, *self._bounds[index]))
        self._refuse_differing(spaces)
        if self._results.apart:
            self.take_apart(relay, shards, deadline)

    def take_apart(self, lane: Lane, shards: Sequence[int], deadline: Deadline) -> None:
        """Have the runners return infos apart, as ``Results.apart`` says."""
        message = m.TakeApart(lane.number, self._results.single)
        requests: list[tuple[int, m.Message]] = [(lane.runners[shard], message) for shard in shards]
        for reply in lane.jail.exchange("make_env", requests, deadline):
            typed_reply(reply, m.Value)

    def _check_built(self, reply: m.BuildDone, start: int, stop: int) -> Pair:
        """Compare the built environment with the manifest; returns its single spaces.
        Trust: input from the worker.
        """
        most = self._repository.policy.limits.elements
        built, wanted = decode_env(reply.manifest, max_elements=most), self._manifest
        count = stop - start if wanted.shardable else wanted.num_envs
        differs = start == 0 and _spaces(built) != _spaces(wanted)  # it describes the first
        if built.num_envs != count or built.autoreset_mode != wanted.autoreset_mode or differs:
            self._refuse()
        return _spaces(built)

    def _refuse_differing(self, spaces: Sequence[Pair]) -> None:
        text = differing(self._manifest.sync, spaces)
        if text:
            raise remote_error("RuntimeError", "RuntimeError", printable(text, _LONGEST))

    def _fast_lane(self, relay: Lane, loaded: LoadedJail, deadline: Deadline) -> Lane:
        """Open the fastest lane that server and runners support; else return the relay.

        Only this function decides which lane an environment has.
        """
        server = loaded.server
        if server.fd_path is None or self._repository.policy.lane == "frames":
            module = "envhub_sandbox.extras.remote.served_lane"
            # the server has room for the slabs of one environment for each runner
            served = extras.find(module, "ServedLane") if self._own else None
            lane: Lane | None = served and served.open(relay, deadline)
            return lane or relay
        # imported late: only Linux has these modules' dependencies
        from envhub_sandbox.transport.shared_memory.attachment import Attachment
        from envhub_sandbox.transport.shared_memory.client_slabs import RING
        from envhub_sandbox.transport.shared_memory.column_lane import ColumnLane
        from envhub_sandbox.transport.shared_memory.lane import SharedMemoryLane

        slots = 1 if self._repository.copy else 1 + RING
        attach = partial(Attachment, server.fd_path, loaded.jail.number, server.process_fd)
        lane = ColumnLane.open(relay, attach, deadline, slots=slots)
        return lane or SharedMemoryLane.open(relay, attach, deadline, slots=slots) or relay

    def _check_manifest(self, loaded: LoadedJail) -> None:
        key = (self._manifest.suite, self._manifest.task)
        described = next((e for e in loaded.manifest.envs if (e.suite, e.task) == key), None)
        if described is None or loaded.changed or _shape(described) != _shape(self._manifest):
            self._refuse()

    def _refuse(self) -> NoReturn:
        self._jails.forget_manifest()
        key = (self._manifest.suite, self._manifest.task)
        raise LoadError(
            f"make_env returned another environment for {key} than before: its result must not "
            "change between calls. The cached description has been removed; call make_env again"
        )


def _shape(manifest: EnvManifest) -> tuple[Any, ...]:
    mode = manifest.autoreset_mode
    return (manifest.num_envs, manifest.shardable, mode, *_spaces(manifest))


def _spaces(manifest: EnvManifest) -> Pair:
    return manifest.single_observation_space, manifest.single_action_space

"""Opens and ends jails for one repository, on the server where its workers run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from envhub_sandbox.errors import (
    EnvHubError,
    LoadError,
    WorkerDiedError,
    WorkerStartupError,
    WorkerTimeoutError,
)
from envhub_sandbox.sandboxes.pool import ServerHold, ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox, may_go_elsewhere, worst_of
from envhub_sandbox.session.error_text import name_denied, read_denials
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.platform import OwnerProcess
from envhub_sandbox.transport.deadline import Deadline, PartDeadline
from envhub_sandbox.transport.output import OutputFollower, OutputSinks
from envhub_sandbox.transport.replies import expect_reply, typed_reply
from envhub_sandbox.transport.values import generator
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest, decode_manifest
from envhub_worker.protocol.records import dataclass

if TYPE_CHECKING:
    from envhub_sandbox.transport.connection import WorkerConnection
    from envhub_sandbox.transport.jail import JailHandle

_PLAY_SHARE, _MOST_PLAY_MS = 0.5, 3_600_000
"""The share of the start's time, and the most milliseconds, for playing sub-environments to see
whether they are independent."""
_CLOSE_S = 5.0
_LOST_S = 1.0
"""How long to try to end a jail after its connection was lost; a living server ends it anyway."""
_SHARE = 0.5
"""The share of the remaining time that one server of several may take to open a jail."""
_SILENT_S = 30.0
"""How long a silent server is not asked again to end a jail."""
_STATUS_S = 1.0
_DENIED_S = 10.0
"""Longer than ``_STATUS_S``: a caller who records denials wants them also from a busy host."""
_UNKNOWN = ("server", "connection", "gone")
"""Reasons of a death for which no server can tell the denials."""


@dataclass(frozen=True)
class ExpectedManifest:
    """The manifest that a repository's ``make_env`` has returned before.
    ``task``: the environment for which the jail is opened.
    ``shards``: the number of runners over which the environment will be spread.
    """

    manifest: Manifest
    task: EnvManifest
    shards: int = 1


class LoadedJail:
    """An open jail whose first runner has called ``make_env``.

    Its owner must give it back. If a Ctrl-C comes before the owner has noted the jail, the
    finalizer gives it back.

    Attributes:
        manifest: The checked manifest of what ``make_env`` returned.
        loaded: The runners that have called ``make_env``.
        use: The use of the jail's server.
        address: The server's address for errors.
        give_back: ``Launcher.close`` or ``Launcher.disconnect``.
        ending: Whether ending the jail has begun.
        closing: Whether a call of ``Launcher.close`` is running.
        ended: Whether its end was requested, so that only the use of the server is left.
        closed: Whether jail and server were given back.
        lost: Whether the connection to the server was lost.
        changed: Whether a runner returned another environment than the manifest says.
    """

    def __init__(
        self,
        jail: JailHandle,
        manifest: Manifest,
        value: dict[str, object],
        loaded: set[int],
        use: ServerUse[WorkerServer],
        give_back: Callable[[LoadedJail], None],
        address: str = "",
    ) -> None:
        self.jail = jail
        self.manifest = manifest
        self.value = value
        self.loaded = loaded
        self.use = use
        self.give_back = give_back
        self.address = address
        self.ending = self.closing = self.ended = self.closed = self.lost = self.changed = False
        self.owner = OwnerProcess()

    @property
    def server(self) -> WorkerServer:
        """The server that runs the jail."""
        return self.use.server

    def __del__(self) -> None:
        # interruption.md, rule 5. At the end of the process the servers end by themselves, so no
        # jail is closed then (rule 13).
        if "owner" not in vars(self):  # the last field: an interrupt came into __init__
            return
        if not self.closed and self.use.live and self.owner.is_here:
            self.ending = True  # its connection may be gone already: end the jail over a new one
            self.give_back(self)


class Launcher:
    """Opens and ends the jails of one repository. Thread-safe.
    ``store``: the folder of the snapshots.

    Attributes:
        runs_on: The interpreter and machine of the workers; a remembered manifest holds only there.
        retry_s: How long to ask again while a server has no room.
        plays: Whether a jail that describes sub-environments also plays them, to see whether they
            are independent; False if that is known.
        server_hold: Keeps the server while an environment may need it again.
    """

    def __init__(self, repository: Repository, sandbox: Sandbox, store: Path) -> None:
        self.repository = repository
        runtime = repository.runtime
        assets = tuple(asset.root for asset in repository.snapshot.assets)
        own = repository.snapshot.root
        confined = sandbox.for_repository(own, repository.policy, runtime, assets)
        self._sandbox = confined
        self.runs_on = confined.runs_on(runtime)
        self.retry_s = confined.retry_s
        self._store = store  # the server may read it
        self._worker = len(repository.places)  # our index in there
        repository.places.append(confined.address)
        ours = object()  # this launcher among the holders
        self.plays = True
        hold, let_go = partial(repository.hold, ours), partial(repository.let_go, ours)
        self.server_hold = ServerHold(self._acquire, hold, let_go)

    def another(self) -> Launcher:
        """A launcher for another worker of the same sandbox."""
        return Launcher(self.repository, self._sandbox, self._store)

    def where(self, loaded: LoadedJail | None) -> str:
        """The address of a jail for errors; for None, the address of the next jail."""
        return self._sandbox.address if loaded is None else loaded.address

    def hold(self) -> Callable[[], None]:
        """Keep the server between two jails; returns the function that releases it."""
        return self._acquire().release

    def _acquire(self, sandbox: Sandbox | None = None) -> ServerUse[WorkerServer]:
        idle_s = self.repository.timeouts.server_idle_s
        return (sandbox or self._sandbox).acquire(self._store, self.repository.runtime, idle_s)

    def open(self, deadline: Deadline, expected: ExpectedManifest | None = None) -> LoadedJail:
        """Fork a jail and have its first runner call ``make_env``.
        ``expected``: the known result of ``make_env``. A suite then need not build each task to
        describe it; the built environment is compared with this manifest later.
        Raises ``LoadError``: the repository failed to load, or returned something unusable;
        ``WorkerError``: the jail did not start, died, or took too long.
        """
        failures: list[EnvHubError] = []
        for sandbox in self._sandbox.candidates():
            try:
                return self._open_at(sandbox, deadline, expected)
            except EnvHubError as error:
                if not may_go_elsewhere(error):
                    raise
                WORKER.info("%s: %s: %s", self.repository.label, sandbox.address, error)
                failures.append(error)
        raise worst_of(failures)

    def _open_at(
        self, sandbox: Sandbox, deadline: Deadline, expected: ExpectedManifest | None
    ) -> LoadedJail:
        began = monotonic()
        use = self._acquire(sandbox)
        if use.server.far is not None:
            deadline.postpone(monotonic() - began)  # a cluster may have started a machine
        loaded: LoadedJail | None = None
        try:  # interruption.md, rule 4
            # a server on another host keeps running anyway
            if self.repository.timeouts.server_idle_s != 0 and use.server.is_ours:
                self.server_hold.keep(use.server)
            with self.repository.starting(deadline):
                loaded = self._open(use, sandbox, deadline, expected)
                self.repository.places[self._worker] = loaded.address = sandbox.address
                return loaded
        except BaseException:
            if loaded is None:
                use.release()
            else:  # not by the finalizer, which does nothing once the use is released
                self.close(loaded)
            raise

    def _open(
        self,
        use: ServerUse[WorkerServer],
        sandbox: Sandbox,
        deadline: Deadline,
        expected: ExpectedManifest | None,
    ) -> LoadedJail:
        server = use.server
        wanted = self._wanted_output()
        client = self._client(server)
        try:
            client.hello(deadline)
            # If the manifest is known, all runners start at once. Otherwise one runner starts, and
            # ``spread`` starts the others when the manifest says how many there are.
            order = self._order(expected.shards if expected else 1)
            order = sandbox.prepare(order, server, client, deadline)
            in_turn = server.far is not None and sandbox is not self._sandbox
            jail = self._open_jail(client, order, deadline, sandbox if in_turn else None)
        except BaseException:
            client.close()
            wanted.close()
            raise
        try:  # interruption.md, rule 4
            jail.warnings = self.repository.warnings
            WORKER.debug("%s: jail %x opened", self.repository.label, jail.number)
            if wanted.sinks:
                connect = partial(self._connected, server)
                follower = OutputFollower(connect, jail.number, wanted)
                jail.before_end = follower.stop
            layers = [*map(dict, server.layers), *jail.report]
            jail.report = self.repository.latest_report = layers
            self.repository.latest_profile = str(order.confinement["profile"])
            if expected is None:
                return self._load(jail, use, deadline)
            loaded = LoadedJail(jail, expected.manifest, {}, set(), use, self.close)
            self.load(loaded, jail.runners, deadline, expected.task)
            return loaded
        except BaseException as error:
            try:
                self.note_denied(error, server, jail.number)
            finally:
                jail.close(Deadline(_CLOSE_S))
            raise

    def _open_jail(
        self,
        client: WorkerConnection,
        order: m.OpenJail,
        deadline: Deadline,
        sandbox: Sandbox | None,
    ) -> JailHandle:
        """Open a jail. If ``sandbox`` is given, there are others, which need time, too.
        Raises ``WorkerStartupError``: this server took too long.
        """
        from envhub_sandbox.transport.jail import open_jail  # sandboxes/process.py says why here

        part = deadline if sandbox is None else PartDeadline(deadline, _SHARE)
        try:
            return open_jail(client, order, self.repository.wire_limits, part)
        except WorkerTimeoutError as error:
            if sandbox is None or deadline.passed:
                raise
            more = option_name("startup_s", 2 * (self.repository.timeouts.startup_s or 1))
            raise WorkerStartupError(
                f"{sandbox.address} has not opened a jail in {part.timeout_s:.0f} s; read that "
                f"server's log, or raise {more}"
            ) from error

    def _client(self, server: WorkerServer) -> WorkerConnection:
        from envhub_sandbox.transport.connection import WorkerConnection

        limits = self.repository.wire_limits
        return WorkerConnection(server.endpoint, server.process_fd, limits, server.far)

    def _connected(
        self, server: WorkerServer, deadline: Deadline | None = None
    ) -> WorkerConnection:
        client = self._client(server)
        try:
            client.hello(deadline or Deadline(_CLOSE_S))
        except BaseException:
            client.close()
            raise
        return client

    def _order(self, runners: int) -> m.OpenJail:
        repository, snapshot = self.repository, self.repository.snapshot
        confinement = asdict(repository.policy.confinement())
        files = str(snapshot.root), snapshot.path
        order = (repository.label, *repository.runtime, *files, confinement, runners)
        return m.OpenJail(*order, snapshot.hub_copies)

    def _load(
        self, jail: JailHandle, use: ServerUse[WorkerServer], deadline: Deadline
    ) -> LoadedJail:
        runner = jail.runners[0]
        left_s = deadline.left_s()
        play_ms = _MOST_PLAY_MS if left_s is None else int(left_s * 1000 * _PLAY_SHARE)
        play_ms = min(play_ms, _MOST_PLAY_MS) if self.plays else 0
        load = m.replace(self.repository.arguments, play_ms=play_ms)
        [reply] = jail.exchange("make_env", [(runner, load)], deadline)
        if not isinstance(reply, m.LoadDone):
            raise LoadError(f"the worker answered Load with {type(reply).__name__}")
        elements = self.repository.policy.limits.elements
        in_time = partial(deadline.check, "the worker's manifest could not be read in time")
        manifest = decode_manifest(
            reply.manifest, max_elements=elements, check=in_time, generator=generator
        )
        return LoadedJail(jail, manifest, reply.manifest, {runner}, use, self.close)

    def _wanted_output(self) -> OutputSinks:
        """The destinations for the output of the next jail; each jail has its own file."""
        output = self.repository.policy.output
        if output in ("stderr", "-"):
            return OutputSinks(self.repository.label, None, stderr=True)
        path = None if output == "tail" else Path(output)
        number = next(self.repository.jail_numbers)
        if path is not None and number > 1:
            path = path.with_name(f"{path.stem}-{number}{path.suffix}")
        return OutputSinks(self.repository.label, path)

    def spread(
        self, loaded: LoadedJail, shards: int, deadline: Deadline, task: EnvManifest
    ) -> list[int]:
        """The first ``shards`` runners of a jail, forked and loaded if needed."""
        jail = loaded.jail
        if len(jail.runners) < shards:
            jail.start_runners(shards - len(jail.runners), deadline)
        runners = jail.runners[:shards]
        fresh = [runner for runner in runners if runner not in loaded.loaded]
        if fresh:
            self.load(loaded, fresh, deadline, task)
        return runners

    def load(
        self, loaded: LoadedJail, runners: list[int], deadline: Deadline, task: EnvManifest
    ) -> None:
        """Have runners of a jail call ``make_env`` for a known task; notes a changed result."""
        jail = loaded.jail
        load = self.repository.arguments
        arguments = load.n_envs, load.use_async_envs, load.cfg, load.env_kwargs
        again = m.LoadTask(*arguments, task.suite, task.task)
        replies = jail.exchange("make_env", [(runner, again) for runner in runners], deadline)
        values = [typed_reply(reply, m.Value).value for reply in replies]
        loaded.changed |= not all(_is_what(value, task) for value in values)
        loaded.loaded.update(runners)

    def connect(self, loaded: LoadedJail, deadline: Deadline) -> LoadedJail:
        """Another connection to an open jail, for an environment that shares it."""
        use = self._acquire()
        try:  # interruption.md, rule 4
            client = self._connected(use.server, deadline)
        except BaseException:
            use.release()
            raise
        jail = loaded.jail.through(client)
        shown = loaded.manifest, loaded.value, loaded.loaded
        return LoadedJail(jail, *shown, use, self.disconnect, loaded.address)

    def disconnect(self, loaded: LoadedJail) -> None:
        """Close a connection that ``connect`` has opened. Idempotent."""
        loaded.jail.client.close()
        loaded.use.release()
        loaded.closed = True

    def close(self, loaded: LoadedJail, *, wait: bool = True) -> None:
        """End a jail and give its server back. Idempotent; an interrupted call can be repeated.
        ``wait``: whether to wait until all processes have ended; otherwise the next close of an
        environment of the repository waits for that.
        """
        if loaded.closed or loaded.closing:  # closed by a signal handler or a thread
            return
        # interruption.md, rule 7: ``ended`` is set after the end was requested, then the use is
        # released, then ``closed`` is set. After an interrupt the next call continues there. After
        # any other error the use is released at once.
        try:
            loaded.closing = True
            if not loaded.ended:
                self._end(loaded, wait=wait)
            loaded.use.release()
            loaded.closed = True
        except Exception:
            loaded.use.release()
            raise
        finally:
            loaded.closing = False

    def _end(self, loaded: LoadedJail, *, wait: bool) -> None:
        if not loaded.ending and not loaded.lost and not loaded.jail.client.torn:
            loaded.ending = True
            WORKER.debug("%s: jail %x closes", self.repository.label, loaded.jail.number)
            wait_for_end = partial(loaded.jail.ask_to_close(), Deadline(_CLOSE_S))
            if wait or not self.server_hold.close_later(loaded.server, wait_for_end):
                wait_for_end()
        else:  # interruption.md, rule 7: the state of this connection is unknown, so use another
            self.interrupt(loaded)
            loaded.jail.drop()
        loaded.ended = True

    def status(
        self, server: WorkerServer, jail: int, timeout_s: float = _STATUS_S
    ) -> dict[str, Any]:
        """What the server says about a jail; empty if it does not answer.

        The question goes over a new connection: on the jail's own, a late reply would be dropped.
        Trust: a server on another host may say anything.
        """
        try:
            status = self._ask(server, m.GetStatus(), Deadline(timeout_s))
            with UNTRUSTED:
                for facts in expect_reply(status, m.Status).jails:
                    if isinstance(facts, dict) and facts.get("jail") == jail:
                        return facts
        except EnvHubError:  # callers can do without: they only show it
            pass
        return {}

    def lives(self, loaded: LoadedJail) -> bool | None:
        """Whether a jail lives, as its server says; None if it does not answer.
        The question restarts the time after which an idle jail ends.
        """
        try:
            check = m.CheckJail(loaded.jail.number, "make_env")
            return isinstance(self._ask(loaded.server, check, Deadline(_CLOSE_S)), m.Done)
        except EnvHubError:
            return None

    def denials(self, server: WorkerServer, jail: int) -> tuple[str, ...] | None:
        """The denials of a jail; None if they are not recorded, or not known any more."""
        if not self.repository.policy.record_denials:
            return None
        return read_denials(self.status(server, jail, _DENIED_S).get("denied"))

    def note_denied(self, error: BaseException, server: WorkerServer, jail: int) -> None:
        """Add a jail's denials to the error that ended it, before the jail is closed."""
        if not isinstance(error, EnvHubError) or error.denied is not None:
            return
        if getattr(error, "reason", "") not in _UNKNOWN:
            error.denied = self.denials(server, jail)
            if isinstance(error, WorkerDiedError) and error.reason in ("exit", "signal"):
                name_denied(error)

    def interrupt(self, loaded: LoadedJail) -> None:
        """End a jail over a new connection, since another thread may wait on the jail's own."""
        loaded.jail.before_end()
        server = loaded.server
        if loaded.lost and monotonic() - server.silent_s < _SILENT_S:
            return
        deadline = Deadline(_LOST_S if loaded.lost else _CLOSE_S)
        try:
            self._ask(server, m.CloseJail(loaded.jail.number), deadline)
        except EnvHubError:  # the server has ended, and the jail with it, or it is silent
            server.silent_s = monotonic()

    def _ask(self, server: WorkerServer, message: m.Message, deadline: Deadline) -> m.Message:
        with contextlib.closing(self._connected(server, deadline)) as client:
            return client.request(message, deadline=deadline)[0]


def _is_what(value: object, task: EnvManifest) -> bool:
    """Whether an answer to ``LoadTask`` is as expected. Trust: input from the worker."""
    if type(value) is not tuple or tuple(map(type, value)) != (int, bool):
        return False  # arrays, for instance, compare to something else than a bool
    return value == (task.num_envs, task.shardable)

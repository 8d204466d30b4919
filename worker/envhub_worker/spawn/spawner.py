"""The server's side of a zygote and of the jails that it forks. Nothing here blocks.

A ``Spawner`` is one zygote. ``spawn`` gives a ``Jail`` at once; what becomes of it arrives as
events from ``Spawner.poll`` and ``Jail.poll``, whenever their descriptors are readable.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import socket
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from envhub_worker.lockdown.context import ZygoteConfig
from envhub_worker.lockdown.limits import cgroups
from envhub_worker.lockdown.mechanisms import process, user
from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder
from envhub_worker.lockdown.mechanisms.scratch import Scratch, remove_tree
from envhub_worker.lockdown.report import LayerUnavailableError
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import OWN, RECORD, Runtime
from envhub_worker.spawn.channel import Channel, close_fds
from envhub_worker.spawn.events import (
    Denied,
    Failed,
    JailEvent,
    Ready,
    RunnerExited,
    RunnerStarted,
    ZygoteDied,
)
from envhub_worker.spawn.zygote_process import ZygoteProcess, resolved

__all__ = [
    "RUNNER_TARGET",
    "Denied",
    "Failed",
    "Jail",
    "JailEvent",
    "JailExited",
    "Ready",
    "RunnerExited",
    "RunnerStarted",
    "Spawner",
    "SpawnerEvent",
    "ZygoteDied",
]

_END_S = 8.0
_LOG_TAIL_BYTES = 8192
RUNNER_TARGET = "envhub_worker.runner.runner:main"


@dataclass(frozen=True)
class JailExited:
    """The init of ``jail`` has gone, and every process of the jail with it."""

    jail: Jail
    code: int | None
    signal: int | None


SpawnerEvent = ZygoteDied | JailExited


class Spawner:
    """One zygote. Owns its process, its jails and a private folder below ``runtime_dir``."""

    def __init__(
        self,
        confinement: Confinement,
        *,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        runtime: Runtime = OWN,
        target: str = RUNNER_TARGET,
        ahead: ZygoteProcess | None = None,
    ) -> None:
        """Execute the zygote; it preloads in the background.

        Args:
            confinement: What the zygote's jails have in common.
            target: What a runner runs once it is confined: ``"module:function"``, or
                ``"/a/file.py:function"``.
            ahead: A process to use, if it is one of this interpreter; else it is ended.
        """
        self._jails: dict[int, Jail] = {}
        self._count = 0
        self._pidfd = -1
        self._exited = False
        self._process = _usable(ahead, runtime) or ZygoteProcess(runtime, runtime_dir)
        self._folder = self._process.folder
        self._user, self._refusal = _choose_user()
        self._apart: LockedFolder | None = None
        self._scratches = self._make_scratches(confinement)
        self._cgroups = self._make_cgroups()
        self._log = self._process.log
        self._channel = self._process.channel
        self._in_use = _keep(runtime.packages)
        config = self._config(confinement, readable_roots, target, runtime.packages)
        self._channel.send(asdict(config))

    def _config(
        self, confinement: Confinement, roots: Sequence[str], target: str, packages: str
    ) -> ZygoteConfig:
        place = self._folder / "root"
        place.mkdir()
        return ZygoteConfig(
            parent=os.getpid(),
            target=target,
            profile=confinement.profile,
            network=confinement.network,
            gpu=confinement.gpu,
            readable=confinement.readable,
            packages=packages and os.path.realpath(packages),
            roots=tuple(roots),
            place=str(place),
            canary=str(self._log),
            user=self._user,
            record=confinement.record_denials,
            refusal=self._refusal,
        )

    def _make_scratches(self, confinement: Confinement) -> Path | None:
        """Where jails without a mount namespace have their writable folders, if they need one."""
        if confinement.profile == "strict":
            return None
        if self._user is None:
            return self._folder
        # The jails' user may not cross root's runtime folder.
        self._apart = LockedFolder("envhub-scratch-")
        self._apart.path.chmod(0o711)
        return self._apart.path

    def _make_cgroups(self) -> cgroups.Tree | None:
        hierarchy = cgroups.discover()
        if hierarchy is not None:
            with contextlib.suppress(OSError):
                return cgroups.Tree(hierarchy, self._folder.name)
        return None

    def fileno(self) -> int:
        """Readable when ``poll`` has something to say."""
        return self._channel.fileno()

    def poll(self) -> list[SpawnerEvent]:
        """What has happened since the last call."""
        if self._exited:
            return []
        self._channel.flush()
        messages, ended = self._channel.drain()
        events = [event for message, fds in messages for event in self._take(message, fds)]
        return events + self._died() if ended else events

    def _take(self, message: dict[str, Any], fds: list[int]) -> list[SpawnerEvent]:
        kind = message["event"]
        if kind == "ready":
            self._pidfd = fds[0]
            return []
        if kind == "spawned":
            self._jails[message["id"]]._attach(fds[0])
            return []
        jail = self._jails.pop(message["id"])
        jail._release()
        return [JailExited(jail, message["code"], message["signal"])]

    def _died(self) -> list[SpawnerEvent]:
        self._exited = True
        events: list[SpawnerEvent] = [ZygoteDied(self._reap_zygote(), self._log_tail())]
        for jail in self._jails.values():
            jail._release()
            events.append(JailExited(jail, None, int(signal.SIGKILL)))
        self._jails.clear()
        return events

    def _reap_zygote(self) -> int:
        """Wait for the zygote, and with it for everything that it started."""
        code = self._process.wait()
        if self._pidfd >= 0:
            # Under namespaces it is a child of the process that we started, killed with it.
            select.select([self._pidfd], [], [], _END_S)
            os.close(self._pidfd)
            self._pidfd = -1
        return code

    def _log_tail(self) -> str:
        return self._log.read_bytes()[-_LOG_TAIL_BYTES:].decode(errors="replace")

    def spawn(self, spec: JailSpec) -> Jail:
        """Ask for a jail. Requests wait until the zygote is ready.

        Raises:
            RuntimeError: The zygote has gone.
        """
        if self._exited:
            raise RuntimeError("the zygote has gone")
        self._count += 1
        # Mounts and Landlock know real paths only.
        spec = replace(spec, snapshot=os.path.realpath(spec.snapshot))
        folder = None if self._scratches is None else self._scratches / f"jail-{self._count}"
        jail = Jail(spec, self, folder, self._user)
        try:
            jail._describe(self._make_group(spec))
            self._channel.send({"op": "spawn", "id": self._count}, jail._theirs)
        except BaseException:
            jail._give_up()
            raise
        self._jails[self._count] = jail
        jail._close_theirs()
        return jail

    def _make_group(self, spec: JailSpec) -> cgroups.Group | None:
        if self._cgroups is not None:
            with contextlib.suppress(OSError):
                return self._cgroups.group(f"jail-{self._count}", spec.confinement.limits)
        return None

    def close(self) -> None:
        """End every process of every jail and the zygote, reap, remove the files. Idempotent."""
        for jail in self._jails.values():
            jail.kill()
        self._channel.close()
        if not self._exited:
            self._reap_zygote()
            self._exited = True
        for jail in self._jails.values():
            jail._release()
        self._jails.clear()
        if self._cgroups is not None:
            self._cgroups.remove()
            self._cgroups = None
        remove_tree(str(self._folder))
        if self._apart is not None:
            self._apart.remove()
        if self._in_use is not None:
            os.close(self._in_use)
            self._in_use = None


def _keep(packages: str) -> int | None:
    """Have nobody remove these packages: a descriptor with the lock of their record, if any."""
    if not packages:
        return None
    record = os.path.join(os.path.dirname(os.path.realpath(packages)), RECORD)
    descriptor = None
    with contextlib.suppress(OSError):  # none, or they are being removed: a jail then says so
        descriptor = os.open(record, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return descriptor


def _usable(ahead: ZygoteProcess | None, runtime: Runtime) -> ZygoteProcess | None:
    if ahead is not None and ahead.runtime != resolved(runtime):
        ahead.discard()
        return None
    return ahead


def _choose_user() -> tuple[int | None, dict[str, str] | None]:
    """(the user that jails become, or None to stay; why that is impossible, or None)."""
    try:
        return user.choose(), None
    except LayerUnavailableError as error:
        return None, error.to_wire()


class Jail:
    """One jail: its init's control channel and its output. Made by ``Spawner.spawn``.

    After ``JailExited``, ``poll`` once more for its last events and close ``output``.
    """

    def __init__(
        self, spec: JailSpec, spawner: Spawner, folder: Path | None, owner: int | None
    ) -> None:
        self.spec = spec
        self.spawner = spawner
        #: Read end of the pipe that holds the jail's stdout and stderr; non-blocking.
        self.output, output = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self.output, False)
        self._folder = folder
        self._count = 0
        self._pidfd = -1
        self._runner_pidfds: dict[int, int] = {}
        self._killed = False
        self._report: list[dict[str, Any]] = []
        self._group: cgroups.Group | None = None
        self._channel, control = Channel.pair()
        self._theirs = (control.detach(), output)
        if folder is not None:
            Scratch.on_host(str(folder)).create(spec.snapshot, owner)

    def _describe(self, group: cgroups.Group | None) -> None:
        """Tell init what it is for, on the channel that only the two of us hold."""
        self._group = group
        message = {
            "spec": self.spec.to_wire(),
            "scratch": str(self._folder),
            "cgroup": group and group.kind,
        }
        fds = group.open() if group else []
        self._channel.send(message, fds)
        close_fds(fds)

    def _close_theirs(self) -> None:
        close_fds(self._theirs)

    def _give_up(self) -> None:
        """Nobody has heard of it."""
        os.close(self.output)
        self._close_theirs()
        self._channel.close()
        self._release()

    def _attach(self, pidfd: int) -> None:
        self._pidfd = pidfd
        if self._killed:
            self._signal_init()

    @property
    def pidfd(self) -> int:
        """A pidfd of the jail's init, or -1 before it is known and after it has gone."""
        return self._pidfd

    @property
    def pid(self) -> int:
        """The number of the jail's init, as seen from here; below 1 before and after its life."""
        try:
            return process.pid_of(self._pidfd)
        except OSError:
            return -1

    def runner_pids(self) -> list[int]:
        """The numbers of its runners that live, as seen from here."""
        pids = map(process.pid_of, self._runner_pidfds.values())
        return [pid for pid in pids if pid > 0]

    def refused_processes(self) -> bool:
        """Whether its control group, if it has one, has refused it any."""
        return self._group is not None and self._group.refused()

    def runner_pidfd(self, runner_id: int) -> int:
        """A pidfd of a runner, or -1 before it has started and after it has gone."""
        return self._runner_pidfds.get(runner_id, -1)

    def fileno(self) -> int:
        """Readable when ``poll`` has something to say; -1 once the jail has gone."""
        return self._channel.fileno()

    def poll(self) -> list[JailEvent]:
        """What has happened in the jail since the last call."""
        if self._channel.fileno() < 0:
            return []
        self._channel.flush()
        messages, ended = self._channel.drain()
        events = [event for message, fds in messages for event in self._translate(message, fds)]
        if ended:
            self._channel.close()
            self._close_runner_pidfds(list(self._runner_pidfds))
        return events

    def _translate(self, message: dict[str, Any], fds: list[int]) -> list[JailEvent]:
        kind = message["event"]
        if kind == "ready":
            self._report = message["report"]
            return []
        if kind == "failed":
            return [Failed(message["layer"], message["reason"], message["fix"])]
        if kind == "runner_started":
            report = self._report + message["report"]
            self._runner_pidfds[message["runner"]] = fds[0]
            pid = process.pid_of(fds[0])
            return [Ready(report), RunnerStarted(message["runner"], pid, report)]
        if kind == "denied":
            return [Denied(message["call"], message["detail"])]
        self._close_runner_pidfds([message["runner"]])
        names = ("runner", "code", "signal", "reason", "detail")
        return [RunnerExited(*(message[name] for name in names))]

    def _close_runner_pidfds(self, runners: Sequence[int]) -> None:
        close_fds(
            [self._runner_pidfds.pop(runner) for runner in runners if runner in self._runner_pidfds]
        )

    def start_runner(self, fds: Sequence[int] = ()) -> tuple[int, socket.socket]:
        """Ask for a runner in this jail; it starts once the jail is ready.

        Args:
            fds: Passed through to ``runner.main``; they stay the caller's.

        Returns:
            The runner's id and the server's end of its stream (``AF_UNIX``, ``SOCK_STREAM``).
            When the jail or the runner dies, the stream ends.
        """
        self._count += 1
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            message = {"op": "start", "runner": self._count}
            if self._channel.fileno() >= 0:
                self._channel.send(message, [theirs.fileno(), *fds])
        return self._count, ours

    def kill_runner(self, runner_id: int) -> None:
        """End a runner and what it started. ``RunnerExited`` follows."""
        if self._channel.fileno() >= 0:
            self._channel.send({"op": "kill", "runner": runner_id})

    def kill(self) -> None:
        """End every process of the jail for certain. ``JailExited`` follows. Idempotent."""
        self._killed = True
        self._channel.close()
        self._signal_init()

    def _signal_init(self) -> None:
        if self._pidfd >= 0:
            # Without a pid namespace, init must itself end what it started.
            signum = signal.SIGTERM if self._folder else signal.SIGKILL
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, signum)

    def _release(self) -> None:
        """Everything in the jail is dead: give back its files and the handle on its init.

        ``output`` and the events not yet polled stay the caller's to read to their end.
        """
        if self._pidfd >= 0:
            os.close(self._pidfd)
            self._pidfd = -1
        self._close_runner_pidfds(list(self._runner_pidfds))
        if self._group is not None:
            self._group.remove()
        if self._folder is not None:
            remove_tree(str(self._folder))

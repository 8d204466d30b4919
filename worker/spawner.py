"""The server's side of a zygote and of the jails that it forks. Nothing here blocks.

A ``Spawner`` is one zygote. ``spawn`` gives a ``Jail`` at once; what becomes of it arrives as
events from ``Spawner.poll`` and ``Jail.poll``, whenever their descriptors are readable.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envhub_worker import bootstrap
from envhub_worker.channel import Channel, close_fds
from envhub_worker.jailspec import JailSpec
from envhub_worker.lockdown.environment import zygote_environment
from envhub_worker.lockdown.scratch import Scratch, link_snapshot, remove_tree
from envhub_worker.protocol.confinement import Confinement

_END_S = 8.0
_LOG_TAIL_BYTES = 8192
HOST_TARGET = "envhub_worker.jail.host:main"


@dataclass(frozen=True)
class ZygoteReady:
    """The zygote has preloaded and forks from now on."""


@dataclass(frozen=True)
class ZygoteDied:
    """The zygote has gone, and every jail with it.

    Attributes:
        code: Its exit code, or minus the signal that ended it.
        log: The end of what it printed.
    """

    code: int
    log: str


@dataclass(frozen=True)
class JailSpawned:
    """The init of ``jail`` exists."""

    jail: Jail


@dataclass(frozen=True)
class JailExited:
    """The init of ``jail`` has gone, and every process of the jail with it."""

    jail: Jail
    code: int | None
    signal: int | None


@dataclass(frozen=True)
class Ready:
    """The jail is set up. ``report``: the layers that hold for all of it."""

    report: list[dict[str, Any]]


@dataclass(frozen=True)
class Failed:
    """A layer that the profile names cannot be had here; the jail ends, nothing has run."""

    layer: str
    reason: str
    fix: str


@dataclass(frozen=True)
class HostStarted:
    """A host is confined, has tested its denials, and now enters ``host.main``.

    Attributes:
        host_id: From ``Jail.start_host``.
        pid: Its pid as the jail sees it.
        report: Every layer that holds for it, the jail's own first.
    """

    host_id: int
    pid: int
    report: list[dict[str, Any]]


@dataclass(frozen=True)
class HostExited:
    """A host has ended.

    Attributes:
        host_id: From ``Jail.start_host``.
        code: Its exit code, or None.
        signal: The number of the signal that ended it, or None.
        reason: ``"exit"``, ``"signal"``, ``"out-of-memory"``, ``"cpu-limit"`` or ``"killed"``.
    """

    host_id: int
    code: int | None
    signal: int | None
    reason: str


@dataclass(frozen=True)
class Disconnected:
    """The jail's control channel has ended: its init is going or gone."""


SpawnerEvent = ZygoteReady | ZygoteDied | JailSpawned | JailExited
JailEvent = Ready | Failed | HostStarted | HostExited | Disconnected


class Spawner:
    """One zygote. Owns its process, its jails and a private folder below ``runtime_dir``."""

    def __init__(
        self,
        confinement: Confinement,
        *,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        python: str | None = None,
        target: str = HOST_TARGET,
    ) -> None:
        """Execute the zygote; it preloads in the background.

        Args:
            confinement: What the zygote's jails have in common.
            runtime_dir: An existing folder of the server's own.
            readable_roots: Where snapshots lie (the snapshot store).
            python: The interpreter of the jails, by absolute path; default: this one.
            target: What a host runs once it is confined: ``"module:function"``, or
                ``"/a/file.py:function"``.
        """
        self._jails: dict[int, Jail] = {}
        self._count = 0
        self._exited = False
        self._folder = Path(tempfile.mkdtemp(prefix="zygote-", dir=runtime_dir))
        self._log = self._folder / "log"
        self._channel, theirs = Channel.pair()
        with theirs:
            self._process = self._execute(theirs.fileno(), python or sys.executable, target)

    def _execute(self, control: int, python: str, target: str) -> subprocess.Popen[bytes]:
        config = {"control": control, "parent": os.getpid(), "target": target}
        with open(self._log, "ab") as log:
            return subprocess.Popen(
                bootstrap.command(python, "zygote", json.dumps(config)),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd="/",
                env=zygote_environment(os.environ, python),
                pass_fds=[control],
                start_new_session=True,
            )

    def fileno(self) -> int:
        """Readable when ``poll`` has something to say."""
        return self._channel.fileno()

    def poll(self) -> list[SpawnerEvent]:
        """What has happened since the last call."""
        if self._exited:
            return []
        self._channel.flush()
        messages, ended = self._channel.drain()
        events = [event for message, fds in messages if (event := self._event(message, fds))]
        if ended:
            events += self._died()
        return events

    def _event(self, message: dict[str, Any], fds: list[int]) -> SpawnerEvent | None:
        if message["event"] == "ready":
            return ZygoteReady()
        jail = self._jails.get(message["id"])
        if jail is None:
            close_fds(fds)
            return None
        if message["event"] == "spawned":
            jail._attach(fds[0])
            return JailSpawned(jail)
        del self._jails[message["id"]]
        jail._release()
        return JailExited(jail, message["code"], message["signal"])

    def _died(self) -> list[SpawnerEvent]:
        self._exited = True
        code = self._reap_zygote()
        events: list[SpawnerEvent] = [ZygoteDied(code, self._log_tail())]
        for jail in self._jails.values():
            jail._release()
            events.append(JailExited(jail, None, int(signal.SIGKILL)))
        self._jails.clear()
        return events

    def _reap_zygote(self) -> int:
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

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
        folder = self._folder / f"jail-{self._count}"
        jail = Jail(spec, folder)
        self._jails[self._count] = jail
        self._channel.send({"op": "spawn", "id": self._count}, jail._theirs)
        jail._close_theirs()
        return jail

    def close(self) -> None:
        """End every process of every jail and the zygote, reap, remove the files. Idempotent."""
        for jail in self._jails.values():
            jail.kill()
        self._channel.close()
        self._reap_zygote()
        self._exited = True
        for jail in self._jails.values():
            jail._release()
        self._jails.clear()
        remove_tree(str(self._folder))


class Jail:
    """One jail: its init's control channel and its output. Made by ``Spawner.spawn``.

    After ``JailExited``, ``poll`` once more for its last events and close ``output``.
    """

    def __init__(self, spec: JailSpec, folder: Path) -> None:
        self.spec = spec
        #: Read end of the pipe that holds the jail's stdout and stderr; non-blocking.
        self.output, output = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self.output, False)
        self._folder = folder
        self._count = 0
        self._pidfd = -1
        self._killed = False
        self._report: list[dict[str, Any]] = []
        self._channel, control = Channel.pair()
        self._theirs = (control.detach(), output)
        self._make_scratch()

    def _make_scratch(self) -> None:
        scratch = Scratch(str(self._folder))
        self._folder.mkdir(mode=0o700)
        scratch.create()
        link_snapshot(self.spec.snapshot, scratch.work)
        self._channel.send({"spec": self.spec.to_wire(), "scratch": scratch.root})

    def _close_theirs(self) -> None:
        close_fds(self._theirs)

    def _attach(self, pidfd: int) -> None:
        self._pidfd = pidfd
        if self._killed:
            self._signal_init()

    def fileno(self) -> int:
        """Readable when ``poll`` has something to say; -1 once the jail has gone."""
        return self._channel.fileno()

    def poll(self) -> list[JailEvent]:
        """What has happened in the jail since the last call."""
        if self._channel.fileno() < 0:
            return []
        self._channel.flush()
        messages, ended = self._channel.drain()
        events = [self._event(message) for message, _ in messages]
        if ended:
            self._channel.close()
            events.append(Disconnected())
        return events

    def _event(self, message: dict[str, Any]) -> JailEvent:
        kind = message["event"]
        if kind == "ready":
            self._report = message["report"]
            return Ready(self._report)
        if kind == "failed":
            return Failed(message["layer"], message["reason"], message["fix"])
        if kind == "host_started":
            report = self._report + message["report"]
            return HostStarted(message["host"], message["pid"], report)
        return HostExited(message["host"], message["code"], message["signal"], message["reason"])

    def start_host(self, fds: Sequence[int] = ()) -> tuple[int, socket.socket]:
        """Ask for a host in this jail; it starts once the jail is ready.

        Args:
            fds: Passed through to ``host.main``; they stay the caller's.

        Returns:
            The host's id and the server's end of its stream (``AF_UNIX``, ``SOCK_STREAM``).
            When the jail or the host dies, the stream ends.
        """
        self._count += 1
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            message = {"op": "start", "host": self._count}
            if self._channel.fileno() >= 0:
                self._channel.send(message, [theirs.fileno(), *fds])
        return self._count, ours

    def kill_host(self, host_id: int) -> None:
        """End a host and what it started. ``HostExited`` follows."""
        if self._channel.fileno() >= 0:
            self._channel.send({"op": "kill", "host": host_id})

    def kill(self) -> None:
        """End every process of the jail for certain. ``JailExited`` follows. Idempotent."""
        self._killed = True
        self._channel.close()
        self._signal_init()

    def _signal_init(self) -> None:
        if self._pidfd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGTERM)

    def _release(self) -> None:
        """Everything in the jail is dead: give back its files and the handle on its init.

        ``output`` and the events not yet polled stay the caller's to read to their end.
        """
        if self._pidfd >= 0:
            os.close(self._pidfd)
            self._pidfd = -1
        remove_tree(str(self._folder))

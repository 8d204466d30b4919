"""The server's handle on one jail, and the jail's events."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from envhub_worker.lockdown.limits.cgroups import Group
from envhub_worker.lockdown.mechanisms import process
from envhub_worker.lockdown.mechanisms.scratch import Scratch, remove_tree
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.records import dataclass
from envhub_worker.spawn.channel import Channel, close_fds


@dataclass(frozen=True)
class JailFailed:
    """This host lacks a layer that the profile requires; the jail ends before any code ran."""

    layer: str
    reason: str
    fix: str


@dataclass(frozen=True)
class RunnerStarted:
    """A runner is confined, has tested its denials, and now enters ``runner.main``.

    Attributes:
        pid: The runner's pid as this process sees it; 0 or less after its end.
        report: Every enforced layer, the jail's own first.
    """

    runner: int
    pid: int
    report: list[dict[str, Any]]


@dataclass(frozen=True)
class RunnerExited:
    """A runner has ended, with an exit code or by a signal.
    ``detail``: the numbers, if a limit was the reason.
    """

    runner: int
    code: int | None
    signal: int | None
    reason: Reason
    detail: str = ""


@dataclass(frozen=True)
class CallDenied:
    """A process of the jail tried a denied system call for the first time.

    Attributes:
        call: The name of the call; for files also "read" or "write".
        detail: The reported argument: a socket family, a path, or nothing.
    """

    call: str
    detail: str


JailEvent = JailFailed | RunnerStarted | RunnerExited | CallDenied
# by the names that ``jail_init`` gives them; the other fields of its messages are theirs
_EVENTS: dict[str, type[JailFailed | RunnerExited | CallDenied]] = {
    "failed": JailFailed,
    "runner_exited": RunnerExited,
    "denied": CallDenied,
}


class Jail:
    """One jail: its init's control channel and its output. Made by ``Spawner.spawn``.

    After ``JailExited``, ``poll`` once more for its last events and close ``output``.

    Attributes:
        output: Read end of the pipe that holds the jail's stdout and stderr; non-blocking.
        theirs: The other ends, for init; ``Spawner`` closes them.
        pidfd: A pidfd of the jail's init; -1 before its start and after its end.
    """

    def __init__(self, spec: JailSpec, folder: Path | None, owner: int | None) -> None:
        self.spec = spec
        self.pidfd = -1
        self.output, output = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self.output, False)
        self._folder = folder  # the writable folders of a jail without a mount namespace, else None
        self._group: Group | None = None  # its control group; without one, init measures its memory
        self._count = 0  # runners asked for so far; the number of the last one
        self._runner_pidfds: dict[int, int] = {}  # by runner; closed when it has ended
        self._killed = False  # also before there is an init: ``attach`` ends it then
        self._report: list[dict[str, Any]] = []  # the jail's own layers, for each runner's report
        self._channel, control = Channel.pair()
        self.theirs = (control.detach(), output)
        if folder is not None:
            Scratch.on_host(str(folder)).create(spec.snapshot, owner)

    def describe(self, group: Group | None) -> None:
        """Send init its specification, on the channel that only the two of us hold."""
        self._group = group
        message = {
            "spec": asdict(self.spec),
            "scratch": str(self._folder),
            "cgroup": group and group.kind,
        }
        fds = group.open() if group else []
        self._channel.send(message, fds)
        close_fds(fds)

    def give_up(self) -> None:
        """Undo the creation of a jail before any zygote has been asked to fork it."""
        os.close(self.output)
        close_fds(self.theirs)
        self._channel.close()
        self.release()

    def attach(self, pidfd: int) -> None:
        """Take note that the zygote has forked the jail's init."""
        self.pidfd = pidfd
        if self._killed:
            self._signal_init()

    @property
    def pid(self) -> int:
        """The pid of the jail's init as this process sees it; below 1 before and after its life."""
        try:
            return process.pid_of(self.pidfd)
        except OSError:
            return -1

    def runner_pids(self) -> list[int]:
        """The pids of the live runners as this process sees them."""
        pids = map(process.pid_of, self._runner_pidfds.values())
        return [pid for pid in pids if pid > 0]

    def refused_processes(self) -> bool:
        """Whether the jail's control group, if any, has refused it a process."""
        return self._group is not None and self._group.refused()

    def runner_pidfd(self, runner: int) -> int:
        """Returns a pidfd of a runner, or -1 before its start and after its end."""
        return self._runner_pidfds.get(runner, -1)

    def fileno(self) -> int:
        """A descriptor that is readable when ``poll`` has events; -1 after the jail's end."""
        return self._channel.fileno()

    def poll(self) -> list[JailEvent]:
        """Returns the jail's events since the last call."""
        if self._channel.fileno() < 0:
            return []
        self._channel.flush()
        messages, ended = self._channel.drain()
        events = [event for message, fds in messages for event in self._translate(message, fds)]
        if ended:
            self._channel.close()
            # Init has ended, and with it every runner: no exit of theirs is reported any more.
            self._close_pidfds(self._runner_pidfds)
        return events

    def _translate(self, message: dict[str, Any], fds: list[int]) -> list[JailEvent]:
        kind = message.pop("event")
        if kind == "ready":
            self._report = message["report"]
            return []
        if kind == "runner_started":
            runner, report = message["runner"], self._report + message["report"]
            self._runner_pidfds[runner] = fds[0]
            return [RunnerStarted(runner, process.pid_of(fds[0]), report)]
        if kind == "runner_exited":
            self._close_pidfds([message["runner"]])
        return [_EVENTS[kind](**message)]

    def _close_pidfds(self, runners: Iterable[int]) -> None:
        for runner in list(runners):
            if runner in self._runner_pidfds:
                os.close(self._runner_pidfds.pop(runner))

    def start_runner(self, fds: Sequence[int] = ()) -> tuple[int, socket.socket]:
        """Ask for a runner in this jail; it starts once the jail is ready.

        Returns its id and the server's end of its stream (``AF_UNIX``, ``SOCK_STREAM``), which ends
        when the jail or the runner dies. ``fds`` go to ``runner.main``, and stay the caller's.
        """
        self._count += 1
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            message = {"op": "start", "runner": self._count}
            if self._channel.fileno() >= 0:
                self._channel.send(message, [theirs.fileno(), *fds])
        return self._count, ours

    def kill_runner(self, runner: int) -> None:
        """End a runner and the processes that it started. ``RunnerExited`` follows."""
        if self._channel.fileno() >= 0:
            self._channel.send({"op": "kill", "runner": runner})

    def kill(self) -> None:
        """End every process of the jail for certain. ``JailExited`` follows. Idempotent."""
        # In this order. The end of the channel ends an init that has not been announced yet, for
        # its pidfd is not here; ``attach`` signals it later. One that hangs in a call does not read
        # its channel.
        self._killed = True
        self._channel.close()
        self._signal_init()

    def _signal_init(self) -> None:
        if self.pidfd >= 0:
            # Without a pid namespace init must end the jail's processes itself: do not kill it.
            signum = signal.SIGTERM if self._folder else signal.SIGKILL
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self.pidfd, signum)

    def release(self) -> None:
        """Release the files and the init's pidfd of a jail whose processes have all ended. Its
        events and its output stay readable.
        """
        if self.pidfd >= 0:
            os.close(self.pidfd)
            self.pidfd = -1
        self._close_pidfds(self._runner_pidfds)
        if self._group is not None:
            self._group.remove()
        if self._folder is not None:
            remove_tree(str(self._folder))

"""The first process of a jail: it sets the jail up, starts runners in it, and ends them all.

Trusted code. The first message on its control channel is the jail's specification,
``{"spec": S, "scratch": folder | null, "cgroup": kind | null}`` with the descriptors of
``cgroups.Group.open``; requests follow::

    {"op": "start", "runner": N} + [the runner's stream, further descriptors...]
    {"op": "kill", "runner": N}

Events::

    {"event": "ready", "report": [layer...]}
    {"event": "failed", "layer": L, "reason": R, "fix": F}                  and it exits
    {"event": "runner_started", "runner": N, "report": [layer...]} + [the runner's pidfd]
    {"event": "runner_exited", "runner": N, "code": C | null, "signal": S | null, "reason": R,
     "detail": D}
    {"event": "denied", "call": C, "detail": D}        where the jail records what it was denied,
                                                       or what was asked of which file

The end of the channel ends the jail.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import traceback
from dataclasses import asdict, dataclass
from typing import Any, NoReturn

from envhub_worker.find_extra import find_extra
from envhub_worker.lockdown.context import Common, JailContext
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.limits.watchdog import Watchdog
from envhub_worker.lockdown.mechanisms import process, procfs, reap
from envhub_worker.lockdown.plan import plan
from envhub_worker.lockdown.seccomp import notify
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.lockdown.stages import jail
from envhub_worker.protocol.confinement import Reason
from envhub_worker.spawn import runner_entry
from envhub_worker.spawn.channel import Channel, close_fds

# Loaded before this process is confined, when it can still read its own files.
denials = find_extra("denials.recorder")


def run(control: int, output: int, common: Common) -> NoReturn:
    """Be the init of a jail in this freshly forked child of the zygote. Never returns."""
    # In this order: the zygote's signal handlers go first, for they would write into its pipe.
    # Then our end is tied to the zygote's, before anything can hold us up. The session is that of
    # all runners: Linux divides busy cores among sessions (``sched(7)``, autogroup), and each
    # runner with its own would queue behind other programs at every step. The output is the
    # jail's before the first line that may print. Only what is named stays open: what else a fork
    # has inherited belongs to the zygote. The specification is read last, when no descriptor is
    # left that it could leak through.
    code = 1
    try:
        process.reset_signals(reap.HANDLED)
        # Without a pid namespace init must live long enough to end what it started.
        signum = signal.SIGKILL if common.namespaced else signal.SIGTERM
        process.die_with_parent(common.pid, signum)
        os.setsid()
        os.dup2(output, 1)
        os.dup2(output, 2)
        process.close_all_but({0, 1, 2, control})
        process.become_subreaper()
        Init(Channel(socket.socket(fileno=control)), common).run()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


@dataclass
class _Runner:
    """An init's record of a runner.

    Attributes:
        status: The channel for the runner's report; None once the runner is confined.
        ended: (reason, detail) if init has ended the runner.
    """

    number: int
    status: Channel | None
    ended: tuple[Reason, str] | None = None


class Init:
    """The loop: requests from the server, reports of runners, limits, and deaths."""

    def __init__(self, channel: Channel, common: Common) -> None:
        self._channel = channel
        self._common = common
        self._runners: dict[int, _Runner] = {}  # by pid; those that are not reaped yet
        self._listeners: set[int] = set()  # where the runners' filters ask what they do not decide
        self._recorder: Any = None  # of denied attempts, if the policy asks for it
        self._running = True  # False once the channel has ended, or at SIGTERM
        self._poller = select.poll()

    def run(self) -> None:
        """Set the jail up and serve until the channel ends."""
        received = self._channel.receive()
        if received is None:
            return
        wakeup = reap.child_signals(self._stop)
        try:
            self._set_up(*received)
            self._loop(wakeup)
        except LayerUnavailableError as error:
            self._channel.send({"event": "failed", **error.to_wire()})
        finally:
            reap.kill_descendants()

    def _set_up(self, message: dict[str, Any], fds: list[int]) -> None:
        spec = JailSpec.from_wire(message["spec"])
        confinement = spec.confinement
        for option, wanted, extra, name in (
            ("record_denials", confinement.record_denials, denials, "denials"),
            ("display", confinement.display != "none", runner_entry.display, "display"),
        ):
            if wanted and extra is None:
                raise LayerUnavailableError(
                    option,
                    f"this worker is installed without envhub_worker.extras.{name}",
                    f"Install the whole package, or leave out {option}.",
                )
        events, *joins = fds or [-1]  # in the order of ``Group.open``
        layers = plan(
            spec.confinement,
            machine=os.uname().machine,
            root=self._common.config.user is not None,
            landlock_abi=self._common.landlock_abi,
            memory=message["cgroup"] or "watchdog",
        )
        scratch, view = jail.enter(spec, self._common, message["scratch"])
        self._jail = JailContext(
            init=os.getpid(),
            spec=spec,
            common=self._common,
            scratch=scratch,
            view=view,
            processes=jail.process_limit(spec.confinement.limits, self._common.namespaced),
            measured=not message["cgroup"],
            joins=joins,
        )
        if confinement.record_denials and denials is not None:
            self._recorder = denials.Recorder(self._jail, self._report_denied)
        self._watchdog = Watchdog(self._jail, events)
        report = [asdict(layer) for layer in (*layers, jail.working_view(view))]
        self._channel.send({"event": "ready", "report": report})

    def _stop(self, *_: object) -> None:
        self._running = False

    def _loop(self, wakeup: int) -> None:
        self._poller.register(self._channel, select.POLLIN)
        self._poller.register(wakeup, select.POLLIN)
        while self._running:
            # until the next look at the limits; a jail without runners needs none
            patience_ms = self._watchdog.seconds_left() * 1000 + 1 if self._runners else None
            ready = [fd for fd, _ in self._poller.poll(patience_ms)]
            for fd in ready:
                if fd == wakeup:
                    reap.drain(wakeup)
                elif fd == self._channel.fileno():
                    self._serve()
                elif fd in self._listeners:
                    self._answer(fd)
                else:
                    for pid, runner in self._runners.items():
                        if runner.status is not None and runner.status.fileno() == fd:
                            self._read_report(pid)
            # Last in each round: what a runner has asked and reported comes before its exit.
            if wakeup in ready:
                self._reap()
            if self._runners:
                self._look()

    def _look(self) -> None:
        if self._watchdog.seconds_left() == 0:
            # A runner that has not reported yet runs only our code, and cannot be measured.
            starting = [pid for pid, runner in self._runners.items() if runner.status is not None]
            over = self._watchdog.look(procfs.descendants(os.getpid(), starting))
            if over is not None:
                # The reason is kept before the kill: an exit by SIGKILL does not tell whose it was.
                for runner in self._runners.values():
                    runner.ended = runner.ended or over
                reap.kill_descendants()

    def _serve(self) -> None:
        received = self._channel.receive()
        if received is None:
            self._running = False
            return
        message, fds = received
        if message["op"] == "start":
            self._start(message["runner"], fds)
        else:
            self._kill(message["runner"])

    def _start(self, number: int, fds: list[int]) -> None:
        status, theirs = Channel.pair()
        pid = os.fork()
        if pid == 0:
            runner_entry.run(self._jail, fds, theirs.fileno(), len(self._runners) + 1)
        # Init's copies of the descriptors go after each fork, or the next runner would have them,
        # too.
        self._watchdog.memory.ignore(fds)
        close_fds(fds)
        theirs.close()
        self._runners[pid] = _Runner(number, status)
        self._poller.register(status, select.POLLIN)

    def _kill(self, number: int) -> None:
        for pid, runner in self._runners.items():
            if runner.number == number:
                runner.ended = runner.ended or ("killed", "")
                # In this order. The runner is not reaped, so the pid is still its own. It is
                # stopped first, so that it cannot fork while its descendants are killed.
                os.kill(pid, signal.SIGSTOP)
                reap.kill_descendants(root=pid)
                os.kill(pid, signal.SIGKILL)

    def _answer(self, listener: int) -> None:
        # No caller is left under this filter: each runner has a listener of its own.
        if not notify.serve(listener, self._common.watched, self._note):
            self._poller.unregister(listener)
            self._listeners.discard(listener)
            os.close(listener)

    def _note(self, request: notify.Request) -> None:
        """Record an attempt, but none of a runner's self-test."""
        if self._recorder is None:
            return
        # Its report may still wait in the channel although it runs a stranger's code by now.
        self._read_report(request.caller)
        runner = self._runners.get(request.caller)
        if runner is None or runner.status is None:
            self._recorder.note(request)

    def _report_denied(self, call: str, detail: str) -> None:
        self._channel.send({"event": "denied", "call": call, "detail": detail})

    def _read_report(self, pid: int) -> None:
        """Read a runner's report of its confinement, if ``pid`` still owes one."""
        runner = self._runners.get(pid)
        if runner is None or runner.status is None:
            return
        status = runner.status
        messages, ended = status.drain()
        for message, fds in messages:
            if "layer" in message:
                # What one runner lacks, all lack: the whole jail fails, and the client learns what
                # is missing.
                raise LayerUnavailableError(**message)
            if "broker" in message:
                self._listeners.update(fds)
                self._poller.register(fds[0], select.POLLIN)
            else:
                fields = {"runner": runner.number, "report": message["report"]}
                # The runner is not reaped: even if it has ended, the pid is still its own.
                self._channel.send_pidfd({"event": "runner_started", **fields}, pid)
        if ended:  # or it died before it was confined: its exit says so
            self._poller.unregister(status)
            status.close()
            runner.status = None

    def _reap(self) -> None:
        # Each report is read just before its runner is reaped: it is sent with a pidfd, which needs
        # the pid.
        ended = list(reap.reap(self._read_report))
        for pid, status in ended:
            runner = self._runners.pop(pid, None)
            if runner is not None:
                fields = {"runner": runner.number, **process.exit_fields(status)}
                # What init has decided comes first: the kernel's own kills look the same from here.
                reason, detail = runner.ended or self._reason(fields["signal"])
                event = {"event": "runner_exited", "reason": reason, "detail": detail, **fields}
                self._channel.send(event)
                self._end_orphans(pid)
        if ended and not self._runners:
            reap.kill_descendants()  # daemons do not outlive the last runner

    def _end_orphans(self, group: int) -> None:
        """End the orphans of a runner while others go on. Daemons end with the last runner."""
        # A runner leads a process group (``runner_entry.confine``), whose number its children have.
        # Only a daemon, or a shell's job, begins a group of its own.
        for pid in procfs.descendants(os.getpid(), keep=self._runners):
            with contextlib.suppress(ProcessLookupError):
                if os.getpgid(pid) == group:
                    os.kill(pid, signal.SIGKILL)

    def _reason(self, signum: int | None) -> tuple[Reason, str]:
        if signum is None:
            return "exit", ""
        if signum == signal.SIGXCPU:
            limit = self._jail.spec.confinement.limits.cpu_time_s
            return "cpu-limit", f"{limit} CPU seconds used (cpu_time_s)"
        return self._watchdog.killed_by_kernel() or ("signal", "")

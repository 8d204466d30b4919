"""The zygote: a clean, single-threaded interpreter that preloads and only forks.

It is executed with ``-I``, a built environment and named descriptors, never runs a stranger's
code and never sees what a jail is for: a jail's specification, with the secrets that its caller
may grant, goes straight from the server to the jail's init, so that no later fork inherits it.

argv: the descriptor of its control channel, and which modules to import at once, before the
confinement: ``ahead`` for all that runners need, ``standard`` for the standard library only, if the
packages of its jails are not the interpreter's own. The first message on the channel is the
configuration with the fields of ``ZygoteConfig`` (every jail could read a command line). Then
requests::

    {"op": "spawn", "id": N} + [init's control socket, the jail's output pipe]

Events::

    {"event": "ready"} + [pidfd of the zygote]
    {"event": "spawned", "id": N} + [pidfd of the init]
    {"event": "exited", "id": N, "code": C | null, "signal": S | null}

The end of the channel ends the zygote and everything below it.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import cast

from envhub_worker.lockdown.context import Common, ZygoteConfig
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import namespaces, process, reap
from envhub_worker.lockdown.stages import zygote
from envhub_worker.spawn import blas, jail_init
from envhub_worker.spawn.channel import Channel, close_fds

# Modules that nearly every runner imports. pyzmq is left out on purpose: a jail holds no ZeroMQ
# socket, and a context started here would not survive the fork.
_PRELOAD = (
    *("cloudpickle", "ctypes", "gymnasium", "gymnasium.spaces", "gymnasium.vector"),
    *("gymnasium.wrappers", "msgpack", "numpy", "numpy.random", "tempfile", "typing"),
)
# Modules of the standard library that numpy and Gymnasium import. They belong to the interpreter,
# so the zygote may import them.
_STANDARD = (
    *("contextvars", "csv", "ctypes", "datetime", "difflib", "heapq", "importlib.metadata"),
    *("importlib.resources", "ipaddress", "locale", "logging", "mmap"),
    *("multiprocessing.connection", "multiprocessing.context", "multiprocessing.sharedctypes"),
    *("numbers", "pathlib", "pickle", "platform", "string", "tempfile", "threading", "typing"),
    *("urllib.parse", "uuid", "zipfile"),
)
_JAIL = "envhub_worker.runner.runner"
_END_S = 5.0


def main(argv: Sequence[str]) -> int:
    """Preload, then fork an init for each request until the server goes away."""
    control = int(argv[0])
    process.close_all_but({0, 1, 2, control})  # first, because every jail inherits descriptors
    channel = Channel(socket.socket(fileno=control))
    gc.disable()  # imports leave no garbage, and collections would take a tenth of their time
    # Before the configuration arrives: the server starts the zygote before it needs a jail.
    if argv[1:] == ["ahead"]:
        preload(_JAIL)
    elif argv[1:] == ["standard"]:
        import_all(_STANDARD)
    received = channel.receive()
    if received is None:
        return 0
    config = ZygoteConfig.from_wire(received[0])
    process.die_with_parent(config.parent, signal.SIGTERM)  # before anything that can take long
    try:
        # First: the packages of another interpreter than the server's are imported confined.
        common = zygote.enter(config)
    except LayerUnavailableError as error:
        refuse(channel, error)
        return 0
    # After ``enter``, which may continue in another process, the first of a pid namespace.
    process.become_subreaper()
    # A repository's output must not be lost in a buffer when its process dies.
    cast(io.TextIOWrapper, sys.stdout).reconfigure(line_buffering=True)
    if not config.packages:
        preload(config.target)
        common = replace(common, set_blas_threads=blas.find_setter())
    # After all imports, so that no collection in a jail writes to the pages that all jails share.
    # From here on this process only forks: it imports nothing and starts no thread.
    gc.freeze()
    gc.enable()
    Zygote(channel, common).run()
    os._exit(0)  # all processes have ended: to take the imports apart again would cost 10 ms


def preload(target: str) -> None:
    """Import the modules that every runner needs: our own code and libraries, no repository's."""
    module, _, _ = target.partition(":")
    import_all([*_PRELOAD, *([] if module.endswith(".py") else [module])])


def import_all(modules: Iterable[str]) -> None:
    """Import each module of a list."""
    for module in modules:
        importlib.import_module(module)


def refuse(channel: Channel, error: LayerUnavailableError) -> None:
    """Answer every request for a jail with the missing layer of this host."""
    while received := channel.receive():
        message, (control, output) = received
        jail_init = Channel(socket.socket(fileno=control))
        jail_init.send({"event": "failed", **error.to_wire()})
        jail_init.close()
        os.close(output)
        channel.send({"event": "exited", "id": message["id"], "code": 1, "signal": None})


class Zygote:
    """The loop: answers the server's requests, and reports the deaths of inits."""

    def __init__(self, channel: Channel, common: Common) -> None:
        self._channel = channel
        self._common = common
        self._inits: dict[int, int] = {}  # the jail's number by its init's pid
        self._running = True  # False after SIGTERM, or at the end of the channel

    def run(self) -> None:
        """Serve until the channel ends or SIGTERM comes; then end everything below."""
        wakeup = reap.child_signals(self._stop)
        poller = select.poll()
        poller.register(self._channel, select.POLLIN)
        poller.register(wakeup, select.POLLIN)
        # The server learns of our end by this pidfd: the process that it started may only wait.
        self._channel.send_pidfd({"event": "ready"}, os.getpid())
        while self._running:
            ready = [fd for fd, _ in poller.poll()]
            if wakeup in ready:
                reap.drain(wakeup)
                self._reap()
            if self._channel.fileno() in ready:
                self._serve()
        self._end()

    def _stop(self, *_: object) -> None:
        self._running = False

    def _serve(self) -> None:
        # In this order. The child leaves this function at once and never returns to the loop. The
        # parent closes its copies of the descriptors before the next fork, or that jail would hold
        # this one's. Then the init is noted, and only then announced: the loop, which is
        # single-threaded, reaps no child in between, so "exited" always comes after "spawned".
        received = self._channel.receive()
        if received is None:
            self._stop()
            return
        message, fds = received
        jail, (control, output) = message["id"], fds
        pid = namespaces.fork_in_new_pid_namespace() if self._common.namespaced else os.fork()
        if pid == 0:
            jail_init.run(control, output, self._common)
        self._inits[pid] = jail
        try:
            self._channel.send_pidfd({"event": "spawned", "id": jail}, pid)
        except OSError as error:  # this jail's end, whose output says why, and no other's
            os.write(output, f"the jail was not announced to the server: {error}\n".encode())
            os.kill(pid, signal.SIGKILL)
        close_fds(fds)

    def _reap(self) -> None:
        gone = False
        for pid, status in reap.reap():
            jail = self._inits.pop(pid, None)
            if jail is not None:
                gone = True
                fields = process.exit_fields(status)
                self._channel.send({"event": "exited", "id": jail, **fields})
        if gone:
            # An init that was killed leaves its orphans to this process, its subreaper.
            reap.kill_descendants(keep=self._inits)

    def _end(self) -> None:
        # Every init sees its own channel end and gets time to end its jail. Then the remaining
        # processes are killed: orphans become children of this process, so it finds them all.
        deadline = time.monotonic() + _END_S
        while self._inits and time.monotonic() < deadline:
            self._reap()
            time.sleep(0.005)
        with contextlib.suppress(ChildProcessError):
            reap.kill_descendants()

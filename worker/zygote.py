"""The zygote: a clean, single-threaded interpreter that preloads and only forks.

It is executed with ``-I``, a built environment and named descriptors, never runs a stranger's
code and never sees what a jail is for: a jail's specification, with the secrets that its caller
may grant, goes straight from the server to the jail's init, so that no later fork inherits it.

argv: one JSON object with the fields of ``ZygoteConfig``. Requests on its control channel::

    {"op": "spawn", "id": N} + [init's control socket, the jail's output pipe]

Events: ``{"event": "ready"}``, ``{"event": "spawned", "id": N}`` + [pidfd of the init],
``{"event": "exited", "id": N, "code": C | null, "signal": S | null}``.
The end of the channel ends the zygote and everything below it.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass

from envhub_worker import init
from envhub_worker.channel import Channel, close_fds
from envhub_worker.lockdown import process, sweep

# What nearly every host imports anyway. pyzmq is left out on purpose: a jail holds no ZeroMQ
# socket, and a context started here would not survive the fork.
_PRELOAD = (
    "cloudpickle",
    "ctypes",
    "gymnasium",
    "gymnasium.spaces",
    "gymnasium.vector",
    "gymnasium.wrappers",
    "msgpack",
    "numpy",
    "numpy.random",
    "tempfile",
    "typing",
)
_END_S = 5.0


@dataclass(frozen=True, kw_only=True)
class ZygoteConfig:
    """How the zygote is started.

    Attributes:
        control: Descriptor of its control socket.
        parent: The server's pid.
        target: What a host runs once it is confined, as ``"module:function"``.
    """

    control: int
    parent: int
    target: str


def main(argv: Sequence[str]) -> int:
    """Preload, then fork an init for each request until the server goes away."""
    config = ZygoteConfig(**json.loads(argv[0]))
    process.die_with_parent(config.parent, signal.SIGTERM)
    process.close_all_but({0, 1, 2, config.control})
    process.become_subreaper()
    for module in _PRELOAD:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()
    Zygote(config).run()
    return 0


class Zygote:
    """The loop: requests from the server, and the deaths of inits."""

    def __init__(self, config: ZygoteConfig) -> None:
        self._config = config
        self._channel = Channel(socket.socket(fileno=config.control))
        self._inits: dict[int, int] = {}
        self._running = True

    def run(self) -> None:
        """Serve until the channel ends or SIGTERM comes; then end everything below."""
        wakeup = sweep.child_signals()
        signal.signal(signal.SIGTERM, self._stop)
        poller = select.poll()
        poller.register(self._channel, select.POLLIN)
        poller.register(wakeup, select.POLLIN)
        self._channel.send({"event": "ready"})
        while self._running:
            ready = [fd for fd, _ in poller.poll()]
            if wakeup in ready:
                sweep.drain(wakeup)
                self._reap()
            if self._channel.fileno() in ready:
                self._serve()
        self._end()

    def _stop(self, *_: object) -> None:
        self._running = False

    def _serve(self) -> None:
        received = self._channel.receive()
        if received is None:
            self._running = False
        else:
            message, fds = received
            self._spawn(message["id"], fds)

    def _spawn(self, jail: int, fds: list[int]) -> None:
        parent = os.getpid()
        control, output = fds
        pid = os.fork()
        if pid == 0:
            init.run(parent, control, output, self._config.target)
        close_fds(fds)
        self._inits[pid] = jail
        pidfd = os.pidfd_open(pid)
        self._channel.send({"event": "spawned", "id": jail}, [pidfd])
        os.close(pidfd)

    def _reap(self) -> None:
        gone = False
        for pid, status in sweep.reap():
            jail = self._inits.pop(pid, None)
            if jail is not None:
                gone = True
                fields = process.exit_fields(status)
                self._channel.send({"event": "exited", "id": jail, **fields})
        if gone:
            # An init that was killed leaves its orphans to us.
            sweep.kill_descendants(keep=self._inits)

    def _end(self) -> None:
        # Every init sees its own channel end; give it the time to end its jail.
        deadline = time.monotonic() + _END_S
        while self._inits and time.monotonic() < deadline:
            self._reap()
            time.sleep(0.005)
        with contextlib.suppress(ChildProcessError):
            sweep.kill_descendants(keep=())

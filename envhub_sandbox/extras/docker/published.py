"""A container behind a port on loopback, for engines that run in a virtual machine.

Engines on macOS and Windows do. Such a container shares no memory, sockets or files with this
process: its server is one for clients on other hosts, and the client uploads the repository's
files. It admits one client, by a key made for it. It ends with its stdin, whose other end only this
process holds.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any, cast

from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.extras.docker import attestation
from envhub_sandbox.extras.docker.container import STARTUP_S, RepositoryContainer, check_started
from envhub_sandbox.extras.docker.engines import Engine, EngineError, environment
from envhub_sandbox.extras.docker.run_arguments import (
    PORT,
    Container,
    run_arguments,
    seccomp_profile,
)
from envhub_sandbox.extras.remote.repository import UploadedRepository
from envhub_sandbox.extras.remote.sandbox import RemoteServer
from envhub_sandbox.extras.remote.tcp import TcpServer, new_keys
from envhub_sandbox.sandboxes.pool import WorkerServer
from envhub_sandbox.sandboxes.process import CONTAINER, RuntimeFolder, remove_stale
from envhub_sandbox.system.platform import OwnerProcess, each_after_fork, own_cpus, own_group
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import key_text, parse_key

_LOOK_S = 0.2
"""One wait: no longer one can be interrupted on Windows."""
_END_S = 15.0
_TAIL_BYTES = 8192
_LINE_BYTES = 65536


@dataclass(eq=False)
class PublishedContainer(RepositoryContainer):
    """The sandbox of one repository: a published container, which its environments share."""

    _files: UploadedRepository = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._files = UploadedRepository(self.snapshot, None, "")

    def prepare(
        self, order: m.OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> m.OpenJail:
        """Bring the files there; not every profile can be had."""
        order = self._files.prepare(order, server, client, deadline)
        profile = cast("PublishedServer", server).profile
        return m.replace(order, confinement={**order.confinement, "profile": profile})

    def _start(self) -> WorkerServer:
        remove_stale()
        container = EngineRun(self.engine)
        try:  # interruption.md, rule 4
            public, secret = new_keys()
            # the engine's processors, not ours, are those of the virtual machine
            seccomp = seccomp_profile(self.engine.machine or None)
            wanted = replace(
                self.wanted(container.folder.path, seccomp, self.engine.cpus or len(own_cpus())),
                only_client=key_text(public),
                profile=self.policy.profile,
            )
            answer = container.start(wanted, STARTUP_S)
            check_started(self.engine, wanted, answer)
            surroundings = attestation.parse(answer)
            layers = attestation.layers(wanted, surroundings, self.title(wanted))
            profile = attestation.profile_for(self.policy.profile, surroundings)
            far = TcpServer(_server_key(answer), secret)
            return PublishedServer(container, far, layers, profile)
        except BaseException:
            container.stop()
            raise


def _server_key(answer: bytes) -> bytes:
    try:
        return parse_key(str(json.loads(answer)["server_key"]))
    except (KeyError, ValueError) as error:
        raise WorkerStartupError(
            "the container's program is not envhub-worker of this version; build the image again"
        ) from error


class PublishedServer(RemoteServer):
    """A worker server in a published container.
    ``profile``: the profile of its jails.
    """

    is_ours = True

    def __init__(
        self, container: EngineRun, far: TcpServer, layers: Sequence[dict[str, Any]], profile: str
    ) -> None:
        self._container = container
        self.layers, self.profile = layers, profile
        super().__init__(container.endpoint(), far)

    @property
    def runs(self) -> bool:
        """Whether the container still runs."""
        return self._container.runs

    def stop(self) -> None:
        """End the connection, and then the container; as ``WorkerServer.stop``."""
        try:
            super().stop()
        finally:
            self._container.stop()


class EngineRun:
    """The engine's attached ``run``, whose stdin keeps its container.
    ``folder``: its runtime folder, which its container names: what is left of both can be found.
    """

    stopped = True  # until there is something to stop

    def __init__(self, engine: Engine) -> None:
        self._owner = OwnerProcess()
        self._engine = engine
        self._name = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._announced: list[bytes] = []
        self._tail = b""
        self.folder = RuntimeFolder(CONTAINER)
        self.stopped = False
        _runs.add(self)

    def start(self, wanted: Container, timeout_s: float) -> bytes:
        """Start a container, and return its announcement, or as JSON how it has ended.
        Raises ``WorkerStartupError``: it has said nothing in that time.
        """
        self._name = wanted.name
        self._process = process = subprocess.Popen(
            [self._engine.command, *run_arguments(self._engine, wanted)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment(),
            **own_group(),  # Ctrl-C is for us, who then end the container
        )
        reader = threading.Thread(target=self._read, args=(process,), daemon=True)
        reader.start()
        until = monotonic() + timeout_s
        while reader.is_alive() and not self._announced:
            if monotonic() > until:
                raise WorkerStartupError(f"the container did not come up in {timeout_s:.0f} s")
            reader.join(_LOOK_S)
        if self._announced:
            return self._announced[0]
        ended = {"ended": process.wait(), "tail": self._tail.decode("utf-8", "replace")}
        return json.dumps(ended).encode()

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        """Read all of its output, so that it never waits for us; look for the announcement."""
        assert process.stdout is not None
        line = b""
        while data := process.stdout.read1(_LINE_BYTES):  # type: ignore[attr-defined]
            self._tail = (self._tail + data)[-_TAIL_BYTES:]
            if not self._announced:
                *lines, line = (line + data).split(b"\n")
                line = line[-_LINE_BYTES:]
                self._announced += [text for text in lines if text.startswith(b'{"envhub-worker"')]

    def endpoint(self) -> str:
        """Where its port is published. Raises ``SandboxUnavailableError``: it is not."""
        try:
            published = self._engine.run("port", self._name, f"{PORT}/tcp").split()
        except EngineError as error:
            published = [str(error)]
        address, _, port = (published or ["nothing"])[0].rpartition(":")
        if address != "127.0.0.1" or not port.isdigit():
            raise SandboxUnavailableError(
                f"{self._engine.kind} does not publish the container's port on loopback: it says "
                f"{' '.join(published)[:200]!r}"
            )
        return f"tcp://127.0.0.1:{port}"

    @property
    def runs(self) -> bool:
        """Whether the container still runs."""
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """End the container; as ``WorkerServer``."""
        if self.stopped or not self._owner.is_here:
            return
        if self._process is not None:
            self.let_go()
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(EngineError):
                    self._engine.run("rm", "--force", "--volumes", self._name)
                self._process.kill()
                self._process.wait()
        self.folder.remove()
        self.stopped = True

    def let_go(self) -> None:
        """Close our end of its stdin; a fork closes its copy, which would keep the container."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def __del__(self) -> None:
        self.stop()  # interruption.md, rule 5: a start was interrupted before it was noted


_runs: weakref.WeakSet[EngineRun] = weakref.WeakSet()
each_after_fork(_runs, EngineRun.let_go)

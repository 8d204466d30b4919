"""One container for one repository, which shares sockets and memory with this process."""

from __future__ import annotations

import json
import os
import secrets
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.extras.docker import attestation, run_arguments
from envhub_sandbox.extras.docker.engines import Engine, environment, explained, own_limits
from envhub_sandbox.extras.docker.run_arguments import Container
from envhub_sandbox.sandboxes.pool import ServerPool, ServerUse, WorkerServer
from envhub_sandbox.sandboxes.process import CONTAINER, LocalServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system.platform import own_cpus, pidfd, readable_within, user_id
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.runtime import OWN, Runtime

_MONITOR = Path(__file__).with_name("monitor.py")
STARTUP_S = 120.0
_STOP_S = 45.0
_ANNOUNCEMENT_BYTES = 65536
# of the engine's own: it failed, it could not run the program, there is no such program
_ENGINES_CODES = (125, 126, 127)
_KILLED = 128 + 9
# Far above the users of distributions, systemd and rootless containers.
_UNUSED_USERS = range(0x6E000000, 0x6EFFFFFF)


@dataclass(kw_only=True)
class ContainerOptions:
    """A caller's options for containers: see ``DockerSandbox``."""

    image: str = "envhub-worker"
    engine: str | None = None
    runtime: str | None = None
    gpus: str | None = None
    memory: int | None = None
    pids: int | None = None
    cpus: float | None = None
    cgroups: bool = True


class ContainerServer(LocalServer):
    """A worker server in a container that we started.
    ``profile``: the profile of its jails.
    ``python``: the jails' interpreter; empty for the server's own.
    """

    wanted: Container

    def __init__(self) -> None:
        super().__init__(CONTAINER, "sockets", _STOP_S)
        self.profile = self.python = ""


_POOL: ServerPool[WorkerServer] = ServerPool()


@dataclass(eq=False)
class RepositoryContainer(Sandbox):
    """The sandbox of one repository: one container, which its environments share."""

    name = "docker"
    options: ContainerOptions
    engine: Engine
    image: str
    snapshot: Path
    policy: Policy
    packages: str = ""
    assets: tuple[Path, ...] = ()

    def runs_on(self, runtime: Runtime) -> Runtime:
        """The id of the image."""
        packages = f" with {self.packages}" if self.packages else ""
        return Runtime(f"{self.image} in {self.engine.kind}{packages}")

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[WorkerServer]:
        """Returns the repository's container; starts one if there is none.

        Its limits are for one ``make_env`` alone, so only an unused one changes hands.
        """
        return _POOL.acquire(repr(self), self._start, idle_s, group=self)

    def prepare(
        self, order: m.OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> m.OpenJail:
        """Files and packages lie elsewhere in there, and not every profile can be had."""
        container = cast("ContainerServer", server)
        trees = dict(run_arguments.asset_places(map(str, self.assets)))
        return m.replace(
            order,
            hub_copies=order.with_trees(trees),
            snapshot=run_arguments.SNAPSHOT,
            # with packages of its own it has no use for those of another environment in the image
            python="" if self.packages else container.python,
            packages=run_arguments.PACKAGES if self.packages else "",
            confinement={**order.confinement, "profile": container.profile},
        )

    def _start(self) -> WorkerServer:
        server = ContainerServer()
        with server.starting(partial(self._execute, server)) as ready:
            answer, wanted = _answer(ready), server.wanted
            check_started(self.engine, wanted, answer)
            surroundings = attestation.parse(answer)
            if not Path(server.fd_path).is_socket():
                raise SandboxUnavailableError(
                    f"{self.engine.kind} started a container whose socket this process cannot use: "
                    "the engine is in a virtual machine, or the runtime has its own kernel. Use "
                    "DockerSandbox(published=True) in Python"
                )
            server.layers = attestation.layers(wanted, surroundings, self.title(wanted))
            server.profile = attestation.profile_for(self.policy.profile, surroundings)
            server.python = surroundings.python
        return server

    def title(self, wanted: Container) -> str:
        """Describes the container, for the report."""
        engine, options = self.engine, self.options
        return (
            f"{engine.kind} {engine.version}, image {options.image} ({self.image[:19]}), "
            f"runtime {options.runtime or 'default'}, {wanted.name}"
        )

    def _execute(self, server: ContainerServer, ready: int) -> subprocess.Popen[bytes]:
        server.wanted = wanted = self._wanted(server.folder)
        with pidfd() as ourselves:
            return subprocess.Popen(
                [
                    *(sys.executable, "-I", "-S", str(_MONITOR), str(ourselves), str(ready)),
                    *(str(server.folder), wanted.name, "--", self.engine.command),
                    *run_arguments.run_arguments(self.engine, wanted),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=environment(),
                pass_fds=(ready, ourselves),
                start_new_session=True,  # Ctrl-C is for the client, which then ends the container
            )

    def _wanted(self, folder: Path) -> Container:
        sockets = folder / "sockets"
        sockets.mkdir(mode=0o700)
        user, group = _user(sockets)
        return replace(
            self.wanted(folder, run_arguments.seccomp_profile(), len(own_cpus())),
            sockets=str(sockets),
            snapshot=str(self.snapshot),
            packages=self.packages,
            assets=tuple(map(str, self.assets)),
            readable=self.policy.readable,
            user=(user, group),
            ulimits=own_limits(self.engine),
        )

    def wanted(self, folder: Path, seccomp: dict[str, Any], cpus: int) -> Container:
        """The container as the image's own user, before any files of this machine are added.
        ``folder``: the client's runtime folder, where the system call profile is written.
        ``cpus``: how many processors there are for it.
        """
        options, policy = self.options, self.policy
        (folder / "seccomp.json").write_bytes(json.dumps(seccomp).encode())
        limits = (
            (options.memory or run_arguments.memory_for(policy)),
            (options.pids or run_arguments.pids_for(policy)),
            (options.cpus or float(cpus)),
        )
        memory, pids, time = limits if options.cgroups else (None, None, None)
        return Container(
            name=f"envhub-{secrets.token_hex(6)}",
            image=self.image,
            labels={
                run_arguments.CLIENT_LABEL: str(os.getpid()),
                run_arguments.FOLDER_LABEL: str(folder),
                run_arguments.USER_LABEL: str(user_id()),
            },
            sockets="",
            snapshot="",
            readable=(),
            seccomp=str(folder / "seccomp.json"),
            user=(run_arguments.IMAGE_USER, run_arguments.IMAGE_USER),
            network="host" if policy.network == "host" else "none",
            memory=memory,
            pids=pids,
            cpus=time,
            scratch=run_arguments.scratch_for(policy),
            runtime=options.runtime,
            gpus=(options.gpus or "all") if policy.gpu else None,
        )


def _user(sockets: Path) -> tuple[int, int]:
    """Returns the user of the container's processes and of the sockets' folder: the caller; for
    root a user that owns nothing else.
    """
    owner = (-1, -1)
    if sys.platform != "win32":
        owner = (os.geteuid(), os.getegid())
        if os.geteuid() == 0:
            user = _UNUSED_USERS[secrets.randbelow(len(_UNUSED_USERS))]
            owner = (user, user)
            os.chown(sockets, user, user)
    return owner


def _answer(ready: int) -> bytes:
    """Reads the monitor's only line."""
    readable = readable_within(ready, STARTUP_S)
    answer = os.read(ready, _ANNOUNCEMENT_BYTES + 1) if readable else b""
    if not answer:
        ending = "ended" if readable else f"did not come up in {STARTUP_S:.0f} s"
        raise WorkerStartupError(f"the container {ending}")
    return answer


def check_started(engine: Engine, wanted: Container, answer: bytes) -> None:
    """Raises an error that says why the container did not start, if it did not.
    Raises ``SandboxUnavailableError``: the engine would not start it; ``WorkerStartupError``: the
    program in it ended.
    """
    if not answer.startswith(b'{"ended"'):
        return
    ending = json.loads(answer)
    tail = str(ending["tail"])
    if ending["ended"] in _ENGINES_CODES:
        limited = wanted.memory is not None
        raise SandboxUnavailableError(explained(engine.kind, tail, limited=limited))
    if ending["ended"] == _KILLED and wanted.memory is not None:
        raise WorkerStartupError(
            "the container's program was killed (SIGKILL) while it started, as the kernel does "
            f"when memory runs out: the container has {wanted.memory >> 20} MiB, and the worker's "
            "own server needs a part of that; raise DockerSandbox(memory=...)"
        )
    raise WorkerStartupError(
        f"the container's program ended at once (exit code {ending['ended']}); an image that was "
        f"built from another version must be built again:\n{tail[-4000:]}"
    )

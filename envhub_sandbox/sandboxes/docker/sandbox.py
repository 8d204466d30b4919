"""``sandbox="docker"``: the worker in a container of its own for each repository.

The container has no network, a read-only root, no capability, limits, and three things from
outside: the repository's files, scratch in memory, and a folder of mode 0700 with two sockets,
over which messages and the fast lane's descriptors travel. Inside, the worker locks each jail
down as it does on a host. What holds is read from inside before anything runs; see
``docs/deployment.md``.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.sandboxes import runtime_folder
from envhub_sandbox.sandboxes.docker import attestation, packages, run_arguments, seccomp_profile
from envhub_sandbox.sandboxes.docker.engines import (
    Engine,
    environment,
    explained,
    find_engine,
    find_image,
    own_limits,
)
from envhub_sandbox.sandboxes.docker.run_arguments import Container
from envhub_sandbox.sandboxes.local_server import LocalServer
from envhub_sandbox.sandboxes.pool import ServerPool, ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system import processes
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.runtime import OWN, Runtime

_MONITOR = Path(__file__).with_name("monitor.py")
_STARTUP_S = 120.0
_STOP_S = 45.0
_ANNOUNCEMENT_BYTES = 65536
# of the engine's own: it failed, it could not run the program, there is no such program
_ENGINES_CODES = (125, 126, 127)
_KILLED = 128 + 9
# Far above the users of distributions, systemd and rootless containers.
_UNUSED_USERS = range(0x6E000000, 0x6EFFFFFF)


@dataclass(kw_only=True)
class DockerSandbox(Sandbox):
    """Workers in containers. What ``sandbox="docker"`` means is this with its defaults.

    Attributes:
        image: The image: ``docker build -t envhub-worker .``, or one that is derived from it.
        engine: ``"docker"`` or ``"podman"``; by default docker, if it answers, else podman.
        runtime: The engine's runtime, such as ``"runsc"``.
        gpus: What ``--gpus`` takes; ``"all"`` where the policy grants the GPU.
        memory: Bytes for all jails of a repository and the server; by default the policy's limit
            and 1 GiB.
        pids: Processes and threads likewise; by default the policy's limit and 256.
        cpus: Processors' worth of time; by default as many as this process may use.
        cgroups: False goes without these three, where an engine cannot limit them.
    """

    image: str = "envhub-worker"
    engine: str | None = None
    runtime: str | None = None
    gpus: str | None = None
    memory: int | None = None
    pids: int | None = None
    cpus: float | None = None
    cgroups: bool = True
    name = "docker"

    def __post_init__(self) -> None:
        for option in ("memory", "pids", "cpus"):
            value = getattr(self, option)
            if value is not None and not value > 0:
                raise PolicyError(f"DockerSandbox: {option} is {value!r}; it takes more than 0")

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> RepositoryContainer:
        """The container for one repository. Starts nothing, but asks for engine and image.

        Raises:
            PolicyError: A container cannot give what the policy permits.
            SandboxUnavailableError: There is no engine, no image, or no permission.
        """
        if runtime.python:
            raise PolicyError(
                f"{option_name('python', runtime.python)} is an interpreter of this machine, and "
                "a container has its own: choose an image instead, with "
                f"{option_name('sandbox', 'docker:IMAGE')}"
            )
        if self.gpus is not None and not policy.gpu:
            raise PolicyError("DockerSandbox(gpus=...) takes a policy with gpu=True")
        if not isinstance(policy.gpu, bool):
            raise PolicyError(
                f"gpu={list(policy.gpu)} names GPUs of this machine, and a container counts its "
                "own: use gpu=True, and choose with DockerSandbox(gpus='device=0')"
            )
        if not sys.platform.startswith("linux"):
            raise SandboxUnavailableError(
                f"{option_name('sandbox', 'docker')} needs Linux, and this is {sys.platform}, "
                "where containers run in a virtual machine: run `docker run envhub-worker` and "
                f"connect to it with {option_name('sandbox', 'tcp://HOST:PORT')}"
            )
        run_arguments.check_readable(policy.readable)
        engine = find_engine(self.engine)
        _check_users(engine)
        image, packages = find_image(engine, self.image), runtime.packages
        return RepositoryContainer(self, engine, image, snapshot, policy, packages, assets)

    def package_target(self) -> packages.ImageTarget:
        """Packages are made on this machine, for the image's Python."""
        return packages.ImageTarget(lambda: find_engine(self.engine), self.image)


def _check_users(engine: Engine) -> None:
    if engine.kind == "docker" and engine.rootless:
        raise SandboxUnavailableError(
            "rootless Docker gives a container no user of yours but its root, whom the worker "
            "refuses to be; use podman (DockerSandbox(engine='podman')), which keeps your id, or "
            "the engine of the system (DOCKER_HOST=unix:///var/run/docker.sock)"
        )


class ContainerServer(LocalServer):
    """A worker server in a container that we started.

    Attributes:
        profile: The profile of its jails, chosen among what can be had in there.
        python: Their interpreter; empty for the server's own.
    """

    wanted: Container

    def __init__(self) -> None:
        super().__init__(runtime_folder.CONTAINER, "sockets", _STOP_S)
        self.profile = self.python = ""


_POOL: ServerPool[ContainerServer] = ServerPool()


@dataclass(eq=False)
class RepositoryContainer(Sandbox):
    """The sandbox of one repository: one container, which its environments share."""

    name = "docker"
    options: DockerSandbox
    engine: Engine
    image: str
    snapshot: Path
    policy: Policy
    packages: str = ""
    assets: tuple[Path, ...] = ()

    def runs_on(self, runtime: Runtime) -> Runtime:
        """The image, by its id."""
        packages = f" with {self.packages}" if self.packages else ""
        return Runtime(f"{self.image} in {self.engine.kind}{packages}")

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[ContainerServer]:
        """The repository's container, started if there is none.

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

    def _start(self) -> ContainerServer:
        server = ContainerServer()
        with server.starting(partial(self._execute, server)) as ready:
            answer, wanted = _answer(ready), server.wanted
            _check_started(self.engine, wanted, answer)
            found = attestation.parse(answer)
            if not Path(server.fd_path).is_socket():
                raise SandboxUnavailableError(
                    f"{self.engine.kind} started a container that shares no socket with this "
                    "process: an engine in a virtual machine, or a runtime with a kernel of its "
                    "own. Run the worker there, and connect to it with "
                    f"{option_name('sandbox', 'tcp://HOST:PORT')}"
                )
            server.layers = attestation.layers(wanted, found, self._title(wanted))
            server.profile = attestation.profile_for(self.policy.profile, found)
            server.python = found.python
        return server

    def _title(self, wanted: Container) -> str:
        engine, options = self.engine, self.options
        return (
            f"{engine.kind} {engine.version}, image {options.image} ({self.image[:19]}), "
            f"runtime {options.runtime or 'default'}, {wanted.name}"
        )

    def _execute(self, server: ContainerServer, ready: int) -> subprocess.Popen[bytes]:
        server.wanted = wanted = self._wanted(server.folder)
        with processes.pidfd() as ourselves:
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
        options, policy = self.options, self.policy
        user, group = _user()
        sockets = folder / "sockets"
        sockets.mkdir(mode=0o700)
        if user != os.geteuid():
            os.chown(sockets, user, group)
        (folder / "seccomp.json").write_text(json.dumps(seccomp_profile.profile()))
        own = len(os.sched_getaffinity(0))
        limits = (
            (options.memory or run_arguments.memory_for(policy)),
            (options.pids or run_arguments.pids_for(policy)),
            (options.cpus or float(own)),
        )
        memory, pids, cpus = limits if options.cgroups else (None, None, None)
        return Container(
            name=f"envhub-{secrets.token_hex(6)}",
            image=self.image,
            labels={
                run_arguments.CLIENT_LABEL: str(os.getpid()),
                run_arguments.FOLDER_LABEL: str(folder),
                run_arguments.USER_LABEL: str(os.geteuid()),
            },
            sockets=str(sockets),
            snapshot=str(self.snapshot),
            packages=self.packages,
            assets=tuple(map(str, self.assets)),
            readable=policy.readable,
            seccomp=str(folder / "seccomp.json"),
            user=(user, group),
            network="host" if policy.network == "host" else "none",
            memory=memory,
            pids=pids,
            cpus=cpus,
            scratch=run_arguments.scratch_for(policy),
            runtime=options.runtime,
            gpus=(options.gpus or "all") if policy.gpu else None,
            ulimits=own_limits(self.engine),
        )


def _user() -> tuple[int, int]:
    """Who the container's processes are: the caller; for root somebody who owns nothing."""
    if os.geteuid() != 0:
        return os.geteuid(), os.getegid()
    user = _UNUSED_USERS[secrets.randbelow(len(_UNUSED_USERS))]
    return user, user


def _answer(ready: int) -> bytes:
    """The monitor's one line."""
    readable, _, _ = select.select([ready], [], [], _STARTUP_S)
    answer = os.read(ready, _ANNOUNCEMENT_BYTES + 1) if readable else b""
    if not answer:
        what = "ended" if readable else f"did not come up in {_STARTUP_S:.0f} s"
        raise WorkerStartupError(f"the container {what}")
    return answer


def _check_started(engine: Engine, wanted: Container, answer: bytes) -> None:
    """Say why there is no container, if there is none.
    Raises ``SandboxUnavailableError``: the engine would not start it; ``WorkerStartupError``: the
    program in it ended.
    """
    if not answer.startswith(b'{"ended"'):
        return
    said = json.loads(answer)
    tail = str(said["tail"])
    if said["ended"] in _ENGINES_CODES:
        limited = wanted.memory is not None
        raise SandboxUnavailableError(explained(engine.kind, tail, limited=limited))
    if said["ended"] == _KILLED and wanted.memory is not None:
        raise WorkerStartupError(
            "the container's program was killed (SIGKILL) while it started, as the kernel does "
            f"where memory runs out: the container has {wanted.memory >> 20} MiB, and the worker's "
            "own server needs a part of that; give it more with DockerSandbox(memory=...)"
        )
    raise WorkerStartupError(
        f"the container's program ended at once (exit code {said['ended']}); an image that was "
        f"built from another version must be built again:\n{tail[-4000:]}"
    )

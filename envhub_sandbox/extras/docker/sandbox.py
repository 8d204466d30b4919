"""``sandbox="docker"``: the worker in a container of its own for each repository.

The container has no network, a read-only root, no capabilities, and limits. Its mounts are the
repository's files and packages, scratch in memory, and a folder of mode 0700 with two sockets,
which carry messages and the fast lane's descriptors. Inside, the worker locks down each jail as on
a host. The server reports its confinement, and the client checks it before any jail runs; see
``docs/deployment.md``. ``published.py`` is for an engine in a virtual machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.extras.docker import run_arguments
from envhub_sandbox.extras.docker.container import ContainerOptions, RepositoryContainer
from envhub_sandbox.extras.docker.engines import Engine, find_engine, find_image
from envhub_sandbox.extras.docker.packages import BuiltImageTarget, ImageTarget
from envhub_sandbox.extras.docker.published import PublishedContainer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system.platform import IS_LINUX, NAME
from envhub_worker.protocol.runtime import Runtime


@dataclass(kw_only=True)
class DockerSandbox(ContainerOptions, Sandbox):
    """Workers in containers. ``sandbox="docker"`` is this with its defaults.

    Attributes:
        image: The image of ``docker build -t envhub-worker .``, or one derived from it.
        engine: ``"docker"`` or ``"podman"``; by default docker, if it answers, else podman.
        runtime: The engine's runtime, such as ``"runsc"``.
        gpus: The value of ``--gpus``; by default ``"all"`` if the policy grants the GPU.
        memory: Bytes for all jails of a repository and the server; by default the policy's limit
            plus 1 GiB.
        pids: Processes and threads of the same; by default the policy's limit plus 256.
        cpus: The number of CPUs, fractions included; by default those that this process may use.
        cgroups: False sets none of these three limits, for an engine that cannot.
        published: Publish a port on loopback, and mount no file of this machine: for an engine in a
            virtual machine. True by default on macOS and Windows.
        build_network: With ``published``, the engine's name of the network for building images with
            a repository's packages.
    """

    published: bool = not IS_LINUX
    build_network: str | None = None
    name = "docker"

    def __post_init__(self) -> None:
        for option in ("memory", "pids", "cpus"):
            value = getattr(self, option)
            if value is not None and not value > 0:
                raise PolicyError(f"DockerSandbox: {option} is {value!r}; it takes more than 0")

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> RepositoryContainer:
        """Return the container for one repository; starts none, but looks for engine and image.
        Raises ``PolicyError``: a container cannot provide something that the policy grants;
        ``SandboxUnavailableError``: there is no engine, no image, or no permission.
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
                f"gpu={list(policy.gpu)} are indices of this machine, and a container has its own: "
                "use gpu=True, and choose with DockerSandbox(gpus='device=0')"
            )
        if self.published:
            return self._published(snapshot, policy, runtime, assets)
        if not IS_LINUX:
            raise SandboxUnavailableError(
                f"on {NAME} containers run in a virtual machine, which shares no memory with this "
                "process: leave published=False out"
            )
        run_arguments.check_readable(policy.readable)
        engine = find_engine(self.engine)
        _check_users(engine)
        image = find_image(engine, self.image)
        return RepositoryContainer(self, engine, image, snapshot, policy, runtime.packages, assets)

    def _published(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...]
    ) -> RepositoryContainer:
        if policy.readable:
            raise PolicyError(
                f"{option_name('readable', list(policy.readable))} are paths of this machine, and "
                "a container in a virtual machine is shown the repository's files only: put what "
                "is needed into the repository"
            )
        engine = find_engine(self.engine)
        # the packages that were made for the repository are an image
        image = find_image(engine, runtime.packages or self.image)
        return PublishedContainer(self, engine, image, snapshot, policy, assets=assets)

    def package_target(self) -> ImageTarget:
        """See ``Sandbox``: packages for the image's Python, on this machine or in an image."""
        engine = partial(find_engine, self.engine)
        if self.published:
            return BuiltImageTarget(engine, self.image, self.build_network)
        return ImageTarget(engine, self.image)


def _check_users(engine: Engine) -> None:
    if engine.kind == "docker" and engine.rootless:
        raise SandboxUnavailableError(
            "with rootless Docker your user is root in a container, and the worker refuses to run "
            "as root; use podman (DockerSandbox(engine='podman')), which keeps your id, or the "
            "engine of the system (DOCKER_HOST=unix:///var/run/docker.sock)"
        )

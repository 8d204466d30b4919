"""From what is wanted to the command line that starts a container. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.docker.engines import Engine
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy

CLIENT_LABEL = "dev.envhub.client"
"""The client's pid, in its own namespace: for people."""
FOLDER_LABEL = "dev.envhub.folder"
"""The runtime folder of the client, which is in use as long as the client lives."""
USER_LABEL = "dev.envhub.user"
"""The user id of the client."""

SOCKETS = "/run/envhub"
"""The only channel: a folder of mode 0700 that client and server share."""
SNAPSHOTS = "/snapshots"
SNAPSHOT = f"{SNAPSHOTS}/this"
"""Where the repository's files lie inside: their path outside stays unknown there."""
PACKAGES = "/packages"
"""Where packages lie inside that were made for the repository."""
PORT = 5555
"""Where a server listens inside whose port is published."""
IMAGE_USER = 65532
"""The image's own user, who owns ``STATE``."""
STATE = "/var/lib/envhub-worker"
"""Where such a server keeps what it is sent."""

_MIB = 1024 * 1024
_OVERHEAD_BYTES = 1024 * _MIB
_OVERHEAD_PIDS = 256
_SHARED_MEMORY_BYTES = 1024 * _MIB
# What a container has of its own. A path of the host over one of these would replace it.
_OWN = frozenset(
    {
        *("bin", "dev", "etc", "lib", "lib32", "lib64", "libx32", "opt", "packages", "proc"),
        *("root", "run", "sbin", "snapshots", "sys", "tmp", "usr", "var"),
    }
)


@dataclass(frozen=True, kw_only=True)
class Container:
    """One container, as it is wanted.

    Attributes:
        image: The image's id.
        sockets: The host's folder that is mounted at ``SOCKETS``.
        snapshot: The host's folder that is mounted at ``SNAPSHOT``, read-only.
        packages: The host's folder that is mounted at ``PACKAGES``, read-only, or empty.
        assets: The host's folders of further repositories, mounted read-only beside it.
        readable: Further paths of the host, read-only, at the same place.
        seccomp: The host's path of the system call profile.
        network: ``"none"`` or ``"host"``.
        memory: Bytes, or None where the engine cannot limit it; swap is not added.
        pids: Processes and threads, or None likewise.
        cpus: Processors' worth of time, or None likewise.
        scratch: Bytes of /tmp.
        runtime: The engine's runtime, or None for its default.
        gpus: What ``--gpus`` takes, or None.
        ulimits: What ``--ulimit`` takes, besides that no core is dumped.
        only_client: The public key of the client, as text, where it comes over a port that is
            published on loopback; then nothing of the host is mounted, and the first two are empty.
        profile: The weakest one that such a server permits.
    """

    name: str
    image: str
    labels: dict[str, str]
    sockets: str
    snapshot: str
    readable: tuple[str, ...]
    seccomp: str
    user: tuple[int, int]
    network: str
    memory: int | None
    pids: int | None
    cpus: float | None
    scratch: int
    runtime: str | None
    gpus: str | None
    ulimits: tuple[str, ...] = ()
    packages: str = ""
    assets: tuple[str, ...] = ()
    only_client: str = ""
    profile: str = "strict"


def run_arguments(engine: Engine, wanted: Container) -> list[str]:
    """What follows the engine's name on the command line."""
    return [
        *("run", "--rm", "--interactive", "--pull", "never", "--log-driver", "none"),
        *("--no-healthcheck", "--name", wanted.name, "--hostname", "sandbox", "--workdir", "/"),
        *(word for name, value in wanted.labels.items() for word in ("--label", f"{name}={value}")),
        *_confinement(engine, wanted),
        *_limits(wanted),
        *_files(wanted),
        *_devices(engine, wanted),
        *([] if wanted.runtime is None else ["--runtime", wanted.runtime]),
        wanted.image,
        *(_listen(wanted) if wanted.only_client else _serve()),
        *("--until-eof", "--announce"),
    ]


def _serve() -> list[str]:
    return [
        *("serve", "--endpoint", f"ipc://{SOCKETS}/server", "--fd-path", f"{SOCKETS}/fds"),
        *("--runtime-dir", "/tmp/envhub-worker", "--readable-root", SNAPSHOTS),
    ]


def _listen(wanted: Container) -> list[str]:
    return [
        *("listen", "--bind", f"tcp://0.0.0.0:{PORT}", "--only-client", wanted.only_client),
        *("--log-level", "warning"),
        # as it is by default where there is Landlock; the caller may choose it where there is none
        *(["--weakest-profile", wanted.profile] if wanted.profile != "strict" else []),
        *(["--allow-network"] if wanted.network == "host" else []),
        *(["--allow-gpu"] if wanted.gpus is not None else []),
    ]


def _confinement(engine: Engine, wanted: Container) -> list[str]:
    user, group = wanted.user
    podman = engine.kind == "podman"
    # /proc as it is: a jail can mount one of its own only where an unmasked one is in sight. What
    # the masks would hide is root's, whom no process in there can become, and jails see none of it.
    unmasked = "unmask=ALL" if podman else "systempaths=unconfined"
    words = ["--network", wanted.network, "--read-only", "--cap-drop", "ALL"]
    if wanted.only_client:  # a port needs a network
        words[1:2] = ["bridge", "--publish", f"127.0.0.1::{PORT}"]
    words += ["--security-opt", "no-new-privileges", "--security-opt", f"seccomp={wanted.seccomp}"]
    words += ["--security-opt", unmasked, "--ipc", "private", "--user", f"{user}:{group}"]
    if podman:
        words.append("--read-only-tmpfs=false")
        if engine.rootless and not wanted.only_client:
            words += ["--userns", "keep-id"]
    elif engine.remapped:
        words += ["--userns", "host"]
    return words


def _limits(wanted: Container) -> list[str]:
    limits = ("core=0:0", *wanted.ulimits)
    words = [word for limit in limits for word in ("--ulimit", limit)]
    if wanted.memory is not None:
        words += ["--memory", str(wanted.memory), "--memory-swap", str(wanted.memory)]
    if wanted.pids is not None:
        words += ["--pids-limit", str(wanted.pids)]
    if wanted.cpus is not None:
        words += ["--cpus", f"{wanted.cpus:g}"]
    if wanted.memory is wanted.pids is wanted.cpus is None:
        words.append("--cgroups=disabled")
    return words


def _files(wanted: Container) -> list[str]:
    scratch = f"rw,nosuid,nodev,size={wanted.scratch},mode=1777"
    own = ["--tmpfs", f"/tmp:{scratch}", "--shm-size", str(_SHARED_MEMORY_BYTES)]
    if wanted.only_client:
        return [*own, "--mount", f"type=volume,dst={STATE}"]  # without a name: it goes, too
    mounts = [
        _mount(wanted.sockets, SOCKETS, read_only=False),
        _mount(wanted.snapshot, SNAPSHOT, read_only=True),
        *([_mount(wanted.packages, PACKAGES, read_only=True)] if wanted.packages else []),
        *(_mount(path, place, read_only=True) for path, place in asset_places(wanted.assets)),
        *(_mount(path, path, read_only=True) for path in wanted.readable),
    ]
    return [*own, *(word for mount in mounts for word in ("--mount", mount))]


def asset_places(assets: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Each asset's folder on the host, and where it lies inside."""
    return ((path, f"{SNAPSHOTS}/asset-{number}") for number, path in enumerate(assets))


def _mount(source: str, target: str, *, read_only: bool) -> str:
    # one value of a line of CSV each, so that a comma or a quote in a path is no separator
    values = ["type=bind", f"src={source}", f"dst={target}", *(["readonly"] if read_only else [])]
    quoted = ['"' + value.replace('"', '""') + '"' for value in values]
    return ",".join(quoted)


def _devices(engine: Engine, wanted: Container) -> list[str]:
    if wanted.gpus is None:
        return []
    if engine.kind == "podman":
        return ["--device", f"nvidia.com/gpu={wanted.gpus}"]
    return ["--gpus", wanted.gpus]


def memory_for(policy: Policy) -> int:
    """Bytes for one jail at its limit, and for the server."""
    return policy.limits.memory_bytes + _OVERHEAD_BYTES


def pids_for(policy: Policy) -> int:
    """Processes for one jail at its limit, and for the server."""
    return policy.limits.processes + _OVERHEAD_PIDS


def scratch_for(policy: Policy) -> int:
    """Bytes of /tmp: a jail's scratch lies there where it has no file system of its own."""
    return policy.limits.disk_bytes + 64 * _MIB


def check_readable(paths: tuple[str, ...]) -> None:
    """Refuse what would replace the container's own files. Raises ``PolicyError``."""
    for path in paths:
        parts = [part for part in path.split("/") if part]
        if ".." in parts or not parts or (len(parts) == 1 and parts[0] in _OWN):
            raise PolicyError(
                f"{option_name('readable')} has {path!r}, which a container replaces by its own; "
                "name the paths below it that are needed"
            )

"""The permissions of a jail, which travel from the client's ``Policy`` to the lockdown; the ways a
jail may end; and the confinement that a container announces around its server.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, Literal, get_args

from envhub_worker.protocol.records import dataclass

MIB = 1024 * 1024
GIB = 1024 * MIB
PROFILES = ("strict", "no-userns", "container")
"""The strongest first."""
NETWORKS = ("none", "loopback", "host")
DISPLAYS = ("none", "virtual")
LEAST_LANDLOCK = {"strict": 1, "no-userns": 3, "container": 0}
"""The Landlock ABI that a profile needs. Without a mount namespace Landlock must itself guard
truncation, which it does from the third on."""
LACKS_PACKAGES = 97
"""The exit code of an interpreter that lacks packages that the worker imports."""
Reason = Literal[
    "exit",
    "signal",
    "out-of-memory",
    "cpu-limit",
    "disk-limit",
    "protocol",
    "zygote",
    "unavailable",
    "killed",
    "idle",
    "server",
    "connection",
    "gone",
]
"""Why a process or a jail has ended; the last three are the client's own, of what it lost."""
REASONS: tuple[Reason, ...] = get_args(Reason)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Hard caps of one jail. None, where it is permitted, sets no cap.

    ``Policy`` also takes texts such as ``"4G"`` for bytes.

    Attributes:
        memory_bytes: All memory of all processes of the jail, shared memory included.
        processes: Processes and threads alive at once.
        cpu_time_s: CPU seconds that one process of the jail may use, or None.
        open_files: File descriptors of one process.
        disk_bytes: Bytes in the jail's scratch (home, temporary files, working directory).
        disk_files: Files and folders in that scratch.
        file_bytes: Size of one file, or None for ``disk_bytes``.
        output_bytes: Last bytes of stdout and stderr that are kept.
        message_bytes: Size of one message from the jail; at least 1 MiB, as an error may need.
        elements: Memory of all spaces and sub-environments of a repository in the client, in
            elements of a float32 ``Box`` (ten bytes each). Equal Boxes count once.
    """

    memory_bytes: int = 8 * GIB
    processes: int = 512
    cpu_time_s: int | None = None
    open_files: int = 1024
    disk_bytes: int = 2 * GIB
    disk_files: int = 100_000
    file_bytes: int | None = None
    output_bytes: int = 64 * 1024
    message_bytes: int = 256 * MIB
    elements: int = 100_000_000


@dataclass(frozen=True, kw_only=True)
class Confinement:
    """One jail's permissions, in the field's words; each mechanism reads its part.

    Attributes:
        profile: Which layers must hold: ``"strict"`` (all), ``"no-userns"``, ``"container"``.
        network: ``"none"``, ``"loopback"`` (its own, empty one) or ``"host"``.
        readable: Further absolute paths that the jail may read.
        gpu: Grants the device nodes of all GPUs, or of those with these indices.
        environment: Environment variables that the caller grants by name, with their values.
        limits: Hard caps.
        record_denials: Init answers denied system calls itself and reports each.
        display: ``"none"``, or ``"virtual"`` for an Xvfb of its own.
    """

    profile: str = "strict"
    network: str = "none"
    readable: tuple[str, ...] = ()
    gpu: bool | tuple[int, ...] = False
    environment: dict[str, str] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)
    record_denials: bool = False
    display: str = "none"


_MAX_NAME = 64


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """The confinement that a container already puts around a process.

    Attributes:
        profiles: Profiles that a jail in the container can have, the strongest first.
        landlock: The kernel's Landlock ABI, or 0.
        user: The user id of the process.
        capabilities: Union of the process's capability sets, as a bit mask.
        no_new_privileges: Whether the process has ``no_new_privs``.
        seccomp: Whether a seccomp filter is installed.
        read_only: Whether the root file system is read-only.
        devices: Names of network devices.
        memory: Memory limit in bytes, or None.
        pids: Limit of processes and threads, or None.
        cpus: CPU limit in processors, or None.
        python: The interpreter for jails; empty for the server's own.
    """

    profiles: tuple[str, ...]
    landlock: int
    user: int
    capabilities: int
    no_new_privileges: bool
    seccomp: bool
    read_only: bool
    devices: tuple[str, ...]
    memory: int | None
    pids: int | None
    cpus: float | None
    python: str

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> Surroundings:
        """Reads an announcement and converts each field to its type. Raises whatever that raises.

        Unknown profiles are left out. Trust: input from the worker.
        """
        fields: dict[str, Any] = {
            name: _read(kind, document[name]) for name, kind in cls.__annotations__.items()
        }
        profiles = tuple(name for name in fields.pop("profiles") if name in PROFILES)
        return cls(profiles=profiles, **fields)


def _read(kind: str, value: Any) -> Any:
    """Converts a value to the type that its field is annotated with."""
    if kind == "bool":
        return value is True
    if kind == "tuple[str, ...]":
        return tuple(str(name)[:_MAX_NAME] for name in value)
    if value is None and kind.endswith(" | None"):
        return None
    return {"int": int, "float": float, "str": str}[kind.removesuffix(" | None")](value)

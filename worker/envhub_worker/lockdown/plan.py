"""Makes an ordered list of layers from a policy and the host's abilities. Pure.

A layer that the profile requires and the host lacks raises an error: nothing degrades silently. The
list includes the layers that a weaker profile omits, with the attacks that stay possible.
"""

from __future__ import annotations

from envhub_worker.lockdown.layers import Layer, LayerUnavailableError, no_system_calls
from envhub_worker.lockdown.mechanisms.landlock import scopes
from envhub_worker.lockdown.seccomp.syscalls import NUMBERS
from envhub_worker.protocol.confinement import LEAST_LANDLOCK, MIB, NETWORKS, PROFILES, Confinement

#: What the kernel counts per user and does not bound per jail.
SHARED_QUOTAS = "pages of pipes, descriptors in flight in sockets, epoll watches"


def needs_broker(*, namespaced: bool, landlock_abi: int) -> bool:
    """Whether only init can keep a jail's signals inside: no pid namespace, no Landlock scope."""
    return not namespaced and not scopes(landlock_abi)


def plan(
    confinement: Confinement, *, machine: str, root: bool, landlock_abi: int, memory: str
) -> tuple[Layer, ...]:
    """Returns the layers for ``confinement`` on a host with these abilities, in order.
    Raises ``LayerUnavailableError``: the profile requires a layer that the host lacks.

    Args:
        landlock_abi: The kernel's Landlock ABI; 0 without Landlock.
        memory: The mechanism that limits memory: ``"cgroup-v2"``, ``"cgroup-v1"``, ``"watchdog"``.
    """
    _check(confinement, machine, landlock_abi)
    limits, namespaced = confinement.limits, confinement.profile == "strict"
    user = Layer("unprivileged-user", True, "a user id without files and processes")
    own = Layer("user-namespace", True, "one user, without capabilities outside")
    brokered = needs_broker(namespaced=namespaced, landlock_abi=landlock_abi)
    signals = Layer("signals", True, "sent by the jail's init, to processes of the jail only")
    ignored = "" if namespaced else "; changes of mode, owner and time are accepted and ignored"
    cpu = "" if limits.cpu_time_s is None else f", {limits.cpu_time_s} CPU seconds"
    rlimits = f"{limits.processes} processes, {limits.open_files} open files{cpu}, no core dumps"
    return (
        *[user] * root,
        *[own] * namespaced,
        *(_namespace_layers(confinement) if namespaced else _without_namespaces(confinement)),
        Layer("capabilities", True, "none in any set"),
        Layer("no-new-privileges", True, "no rights from set-user-id programs"),
        _landlock_layer(landlock_abi),
        *[signals] * brokered,
        Layer("seccomp", True, f"allow-list for {machine}{ignored}"),
        Layer("rlimits", True, rlimits),
        *_limit_layers(confinement, root, memory, namespaced),
    )


def _check(confinement: Confinement, machine: str, landlock_abi: int) -> None:
    """Raise ``LayerUnavailableError`` for a profile that this host cannot enforce, or not with
    these options.
    """
    for name, value, permitted in (
        ("profile", confinement.profile, PROFILES),
        ("network", confinement.network, NETWORKS),
    ):
        if value not in permitted:
            raise LayerUnavailableError(
                name, f"there is no {name} {value!r}", f"Choose one of {', '.join(permitted)}."
            )
    if machine not in NUMBERS:
        raise no_system_calls(machine)
    least = LEAST_LANDLOCK[confinement.profile]
    if landlock_abi < least:
        have = f"ABI {landlock_abi}" if landlock_abi else "none"
        raise LayerUnavailableError(
            "landlock",
            f"the profile {confinement.profile} needs Landlock ABI {least}, this kernel has {have}",
            "ABI 1 needs Linux 5.13, ABI 3 Linux 6.2; it must be in the kernel's lsm= list, and "
            "a container's seccomp profile must allow it.",
        )
    if confinement.profile != "strict" and confinement.network == "loopback":
        raise LayerUnavailableError(
            "network-namespace",
            f"the profile {confinement.profile} has no network namespace",
            'Use profile "strict", or the network "none".',
        )
    if confinement.profile != "strict" and confinement.display != "none":
        raise LayerUnavailableError(
            "display",
            f"the profile {confinement.profile} permits no socket files, which a display needs",
            'Use profile "strict", or leave the display out.',
        )


def _namespace_layers(confinement: Confinement) -> list[Layer]:
    limits = confinement.limits
    network = {
        "host": "the host's network, by explicit choice",
        "loopback": "only a loopback device",
    }.get(confinement.network, "no active device")
    scratch = f"one tmpfs of {limits.disk_bytes // MIB} MiB and {limits.disk_files} files"
    return [
        Layer("pid-namespace", True, "sees and signals only its own processes"),
        Layer("mount-namespace", True, "a private read-only root; other files do not exist"),
        Layer("scratch", True, scratch),
        Layer("network-namespace", confinement.network != "host", network),
        Layer("ipc-namespace", True, "its own System V and POSIX objects"),
        Layer("uts-namespace", True, "a neutral host name"),
        Layer("cgroup-namespace", True, "its own view of control groups"),
    ]


def _without_namespaces(confinement: Confinement) -> list[Layer]:
    why = f"the profile {confinement.profile} goes without"
    network = Layer("network", True, "only connected local socket pairs")
    if confinement.network == "host":
        network = Layer("network", False, "the host's network, by explicit choice")
    return [
        Layer("pid-namespace", False, f"{why}: processes of the host are visible"),
        Layer("mount-namespace", False, f"{why}: names and sizes of the host's files are visible"),
        network,
    ]


def _landlock_layer(abi: int) -> Layer:
    if not abi:
        return Layer("landlock", False, "this kernel or container has none")
    scope = ", TCP" * (abi >= 4) + ", signals and abstract sockets" * scopes(abi)
    return Layer("landlock", True, f"ABI {abi}: files{scope}")


def _uncounted(confinement: Confinement, memory: str, namespaced: bool) -> str:
    """Returns the kinds of a jail's memory that nothing counts here, for the report."""
    names = ["file locks"]
    if confinement.gpu is not False:
        names.append("memory of the GPU's driver")
    if memory == "watchdog":
        names.append("epoll watches")
        if confinement.gpu is not False:  # drivers need them, so that the filter permits them
            names.append("memfds and shared memory that are mapped nowhere, or in part")
        if not namespaced:
            names.append("sockets that wait in sockets")
        if confinement.network == "host":
            names.append("buffers of network connections")
    return ", ".join(names)


def _limit_layers(
    confinement: Confinement, root: bool, memory: str, namespaced: bool
) -> list[Layer]:
    uncounted = f"; not counted: {_uncounted(confinement, memory, namespaced)}"
    amount = f"{confinement.limits.memory_bytes // MIB} MiB"
    detail = {
        "cgroup-v2": f"{amount}, counted by the kernel (cgroup v2)",
        "cgroup-v1": f"{amount}, counted by the kernel (cgroup v1)",
        "watchdog": f"{amount}, measured by the jail's init; bursts between two looks overshoot",
    }
    # The kernel counts these per user, so a jail takes them from the user's other programs.
    shared = f"shared with this user's programs: {SHARED_QUOTAS}"
    alone = "jails of root, or of a user who runs nothing else, have their own"
    quotas = Layer("user-quotas", False, f"{shared}; {alone}")
    if root:
        quotas = Layer("user-quotas", True, "its own: no other program runs as this user")
    layers = [Layer("memory", True, detail[memory] + uncounted), quotas]
    if not namespaced:
        disk = f"{confinement.limits.disk_bytes // MIB} MiB, measured by the jail's init"
        layers.append(Layer("scratch", True, disk))
    return layers

"""Compares the confinement that a container's server reports with the requested one. Pure.

Trust: the server is our code, but in an image that the caller chose. This module checks bounds and
types of the report, and any mismatch is an error.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from envhub_sandbox.errors import RemoteProtocolError, SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.extras.docker.run_arguments import Container
from envhub_sandbox.settings.options import option_name
from envhub_worker.protocol.confinement import Surroundings
from envhub_worker.protocol.errors import UNTRUSTED

_MIB = 1024 * 1024
_NATIVE_RUNTIMES = (None, "runc", "crun", "io.containerd.runc.v2")


def parse(line: bytes) -> Surroundings:
    """Parses a server's announcement. Raises ``WorkerStartupError``: it is malformed."""
    try:
        with UNTRUSTED:
            return Surroundings.read(json.loads(line))
    except RemoteProtocolError as error:
        raise WorkerStartupError(
            "the image has another version of envhub-worker; build it again"
        ) from error


def profile_for(wanted: str, surroundings: Surroundings) -> str:
    """Returns the profile of jails in a container if the policy names ``wanted``.

    The container itself confines every jail. So ``"strict"`` means the strongest profile that works
    in the container, if that separates a jail from the server beside it, by namespaces or Landlock.
    A weaker profile is used as named.
    Raises ``SandboxUnavailableError``: the container cannot enforce the profile.
    """
    if wanted != "strict":
        if wanted in surroundings.profiles:
            return wanted
        raise SandboxUnavailableError(
            f"the profile {wanted!r} cannot be had in this container; it can give "
            f"{', '.join(surroundings.profiles) or 'none'}"
        )
    if "strict" in surroundings.profiles:
        return "strict"
    if "container" in surroundings.profiles and surroundings.landlock >= 1:
        return "container"
    raise SandboxUnavailableError(
        "this container permits neither namespaces nor Landlock, so only a system call filter "
        "would separate the repository from the server that runs it. If the container's own "
        f"confinement is enough, use {option_name('profile', 'container')}."
    )


def layers(wanted: Container, surroundings: Surroundings, title: str) -> list[dict[str, Any]]:
    """What holds around every jail, for the report.
    ``title``: engine and image, for the first line.
    Raises ``SandboxUnavailableError``: something that was asked for does not hold.
    """
    checks: Sequence[tuple[str, bool, str]] = (
        (
            "container-user",
            surroundings.user == wanted.user[0] != 0,
            f"user {surroundings.user}, not root",
        ),
        ("container-capabilities", surroundings.capabilities == 0, "none in any set"),
        ("container-privileges", surroundings.no_new_privileges, "no new ones can be gained"),
        ("container-files", surroundings.read_only, "a read-only root, the snapshot, and scratch"),
        *_chosen(wanted, surroundings),
    )
    for layer, holds, _ in checks:
        if not holds:
            raise _does_not_hold(layer, wanted, surroundings)
    report = [{"layer": "container", "enforced": True, "detail": title}]
    report += [{"layer": name, "enforced": True, "detail": detail} for name, _, detail in checks]
    return [*report, *_absent(wanted)]


def _chosen(wanted: Container, surroundings: Surroundings) -> Iterator[tuple[str, bool, str]]:
    """Yields the layers that only some containers request."""
    if wanted.network == "none" and not wanted.only_client:
        own = set(surroundings.devices) <= {"lo"}
        yield "container-network", own, "no device but its own loopback"
    if wanted.runtime in _NATIVE_RUNTIMES:  # else another kernel than the host's answers
        yield "container-seccomp", surroundings.seccomp, "an allow-list around the jail's own"
    for name, most, has in (
        ("memory", wanted.memory, surroundings.memory),
        ("pids", wanted.pids, surroundings.pids),
        ("cpus", wanted.cpus, surroundings.cpus),
    ):
        if most is not None:
            holds = has is not None and has <= most * 1.01
            amounts = {
                "memory": f"{most / _MIB:.0f} MiB for all jails and the server",
                "pids": f"{most:.0f} processes and threads",
                "cpus": f"the time of {most:g} processors",
            }
            yield f"container-{name}", holds, amounts[name]


def _absent(wanted: Container) -> list[dict[str, Any]]:
    """Returns the layers that the caller has given up."""
    missing = []
    if wanted.only_client:
        who = "jails have none of it" if wanted.network == "none" else "and jails, by choice"
        bridge = f"a bridge, for the port that is published on loopback; {who}"
        missing.append(("container-network", bridge))
    elif wanted.network != "none":
        missing.append(("container-network", "the host's network, by explicit choice"))
    if wanted.runtime not in _NATIVE_RUNTIMES:
        missing.append(("container-seccomp", f"the runtime {wanted.runtime} has rules of its own"))
    if wanted.memory is None:
        missing.append(("container-memory", "without control groups, by explicit choice"))
    return [{"layer": name, "enforced": False, "detail": detail} for name, detail in missing]


def _does_not_hold(
    layer: str, wanted: Container, surroundings: Surroundings
) -> SandboxUnavailableError:
    fault = f"the engine started the container, but {layer} does not hold in it"
    if layer in ("container-memory", "container-pids", "container-cpus"):
        return SandboxUnavailableError(
            f"{fault}: this host's control groups do not permit that limit. Enable them, or use no "
            "limits of the container: DockerSandbox(cgroups=False). Each jail still has its own "
            "limits."
        )
    return SandboxUnavailableError(
        f"{fault}: {surroundings}, wanted {wanted.user}. Nothing was run."
    )

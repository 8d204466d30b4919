"""What a container does to this process, as read and tried from inside: no claim is believed.

The client asks an engine for a container by its flags. An engine may ignore one with a warning
(a limit that the host's control groups cannot give), and the flags say nothing of what works
inside. So the server says what it finds, before it serves, and the client compares.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from envhub_worker import __version__
from envhub_worker.lockdown import probe
from envhub_worker.lockdown.mechanisms import landlock, procfs
from envhub_worker.protocol.confinement import LEAST_LANDLOCK, Surroundings
from envhub_worker.protocol.runtime import OWN, Runtime

ENVIRONMENT = Path("/opt/environment/bin/python")
"""The interpreter of jails in an image that was derived for a repository."""
_CGROUPS = Path("/sys/fs/cgroup")
_NAMESPACED = frozenset({"user-namespace", "namespaces", "mount-namespace", "landlock", "seccomp"})


def announcement(found: Surroundings, **more: str) -> str:
    """One line of JSON for the client that started the container. ``more``: of a server there."""
    return json.dumps({"envhub-worker": __version__, **vars(found), **more})


def own_runtime() -> Runtime:
    """What jails run on where nothing else is said: in a derived image its environment."""
    return Runtime(str(ENVIRONMENT)) if ENVIRONMENT.exists() else OWN


def surroundings() -> Surroundings:
    """What holds around this process. Call it before it has threads."""
    status = _status()
    return Surroundings(
        profiles=tuple(profiles(probe.probe()["layers"], landlock.version())),
        landlock=landlock.version(),
        user=os.geteuid(),
        capabilities=_capabilities(status),
        no_new_privileges=status.get("NoNewPrivs") == "1",
        seccomp=status.get("Seccomp") == "2",
        read_only=bool(os.statvfs("/").f_flag & os.ST_RDONLY),
        devices=tuple(network_devices(Path("/proc/net/dev").read_text())),
        memory=memory_limit(_CGROUPS),
        pids=pids_limit(_CGROUPS),
        cpus=cpus_limit(_CGROUPS),
        python=own_runtime().python,
    )


def profiles(layers: list[dict[str, Any]], landlock_abi: int) -> list[str]:
    """Which profiles' layers are all there; a pure function of what ``probe`` found."""
    there = {layer["layer"] for layer in layers if layer["available"]}
    found = ["strict"] if there >= _NAMESPACED else []
    if "seccomp" in there and landlock_abi >= LEAST_LANDLOCK["no-userns"]:
        found.append("no-userns")
    return [*found, "container"] if "seccomp" in there else found


def network_devices(table: str) -> list[str]:
    """The names in ``/proc/net/dev``."""
    return [line.partition(":")[0].strip() for line in table.splitlines() if ":" in line]


def memory_limit(root: Path) -> int | None:
    """Bytes, from cgroup v2 or v1; None where there is no limit."""
    limit = _number(root / "memory.max") or _number(root / "memory/memory.limit_in_bytes")
    # under v1, "none" is written as the largest number of pages
    return limit if limit is not None and limit < 1 << 60 else None


def pids_limit(root: Path) -> int | None:
    """Processes and threads, from cgroup v2 or v1; None where there is no limit."""
    return _number(root / "pids.max") or _number(root / "pids/pids.max")


def cpus_limit(root: Path) -> float | None:
    """Processors' worth of time, from cgroup v2 or v1; None where there is no limit."""
    quota, period = _words(root / "cpu.max", 2)
    if not quota:
        for folder in ("cpu", "cpu,cpuacct"):
            [quota] = _words(root / folder / "cpu.cfs_quota_us", 1)
            [period] = _words(root / folder / "cpu.cfs_period_us", 1)
            if quota:
                break
    if not quota.isdigit() or not period.isdigit():
        return None
    return int(quota) / int(period)


def _number(path: Path) -> int | None:
    [word] = _words(path, 1)
    return int(word) if word.isdigit() else None


def _words(path: Path, count: int) -> list[str]:
    words = (procfs.text(str(path)) or "").split()
    return [*words, *[""] * count][:count]


def _status() -> dict[str, str]:
    lines = Path("/proc/self/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def _capabilities(status: dict[str, str]) -> int:
    held = 0
    for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"):
        held |= int(status[name], 16)
    return held

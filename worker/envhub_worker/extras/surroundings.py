"""Measures the confinement that a container puts around its server, for the client that started it.

The client starts a container with an engine's flags, but an engine may ignore a flag with a warning
(a limit that the host's control groups cannot give), and flags do not tell what works inside. So
the server in the container reads and tries its confinement before it serves, and reports it; the
client compares the report with its flags.
"""

from __future__ import annotations

import functools
import json
import operator
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


def announcement(surroundings: Surroundings, **more: str) -> str:
    """Returns one line of JSON for the client that started the container. ``more``: further fields
    about a server in it.
    """
    return json.dumps({"envhub-worker": __version__, **vars(surroundings), **more})


def own_runtime() -> Runtime:
    """Returns the jails' default runtime: the environment of a derived image, if it has one."""
    return Runtime(str(ENVIRONMENT)) if ENVIRONMENT.exists() else OWN


def measure() -> Surroundings:
    """Returns the confinement around this process, which must be single-threaded."""
    lines = Path("/proc/self/status").read_text().splitlines()
    status = {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}
    sets = ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")
    held = (int(status[name], 16) for name in sets)
    return Surroundings(
        profiles=tuple(profiles(probe.probe()["layers"], landlock.version())),
        landlock=landlock.version(),
        user=os.geteuid(),
        capabilities=functools.reduce(operator.or_, held),
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
    """Returns the profiles whose layers are all available by a result of ``probe``. Pure."""
    available = {layer["layer"] for layer in layers if layer["available"]}
    enforceable = ["strict"] if available >= _NAMESPACED else []
    if "seccomp" in available and landlock_abi >= LEAST_LANDLOCK["no-userns"]:
        enforceable.append("no-userns")
    return [*enforceable, "container"] if "seccomp" in available else enforceable


def network_devices(table: str) -> list[str]:
    """Returns the names in ``/proc/net/dev``."""
    return [line.partition(":")[0].strip() for line in table.splitlines() if ":" in line]


def memory_limit(root: Path) -> int | None:
    """Returns the memory limit in bytes, from cgroup v2 or v1; None without a limit."""
    limit = _number(root / "memory.max") or _number(root / "memory/memory.limit_in_bytes")
    # Cgroup v1 writes the largest number of pages for "no limit".
    return limit if limit is not None and limit < 1 << 60 else None


def pids_limit(root: Path) -> int | None:
    """Returns the limit of processes and threads, from cgroup v2 or v1; None without a limit."""
    return _number(root / "pids.max") or _number(root / "pids/pids.max")


def cpus_limit(root: Path) -> float | None:
    """Returns the CPU limit in processors, from cgroup v2 or v1; None without a limit."""
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

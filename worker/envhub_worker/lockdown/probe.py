"""Finds out what this host can enforce by trying it in throwaway processes.

``python -I bootstrap.py probe`` prints one JSON object for ``envhub doctor``::

    {"host": {...}, "layers": [{"layer", "available", "detail", "fix"}...],
     "apparmor_profile": text | null}

It tries the layers one by one and lists all missing ones; a jail would stop at the first.

``surroundings`` is for a container. The client starts one with an engine's flags, but an engine may
ignore a flag with a warning (a limit that the host's control groups cannot give), and flags do not
tell what works inside. So the server in the container reads and tries its confinement before it
serves, and reports it; the client compares the report with its flags.
"""

from __future__ import annotations

import functools
import json
import operator
import os
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from envhub_worker import __version__
from envhub_worker.lockdown import gpus, root_plan
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.limits import cgroups
from envhub_worker.lockdown.mechanisms import (
    kernel,
    landlock,
    mounts,
    namespaces,
    process,
    procfs,
    user,
)
from envhub_worker.lockdown.seccomp import filter
from envhub_worker.protocol.confinement import LEAST_LANDLOCK, Surroundings
from envhub_worker.protocol.runtime import OWN, Runtime

ENVIRONMENT = Path("/opt/environment/bin/python")
"""The interpreter of jails in an image that was derived for a repository."""
_CGROUPS = Path("/sys/fs/cgroup")
_NAMESPACED = frozenset({"user-namespace", "namespaces", "mount-namespace", "landlock", "seccomp"})

_APPARMOR = """\
abi <abi/4.0>,
include <tunables/global>

profile envhub-worker {python} flags=(unconfined) {{
  userns,
  include if exists <local/envhub-worker>
}}
"""


def main(argv: Sequence[str]) -> int:
    """Print the layers that this host can enforce as JSON."""
    os.umask(0o022)  # as for the server: what is tried must not depend on the caller's
    print(json.dumps(probe(), indent=2))
    return 0


def probe() -> dict[str, Any]:
    """Returns every layer that this host can enforce. This process must be single-threaded."""
    restricted = procfs.text("/proc/sys/kernel/apparmor_restrict_unprivileged_userns") == "1"
    return {
        "host": host_facts(),
        "layers": [try_layer(name, attempt) for name, attempt in _LAYERS.items()],
        "apparmor_profile": apparmor_profile() if restricted and os.geteuid() != 0 else None,
    }


def host_facts() -> dict[str, Any]:
    """Returns facts about kernel, machine and user."""
    name = os.uname()
    hierarchy = cgroups.discover()
    return {
        "kernel": name.release,
        "machine": name.machine,
        "user": "root" if os.geteuid() == 0 else "plain user",
        "python": sys.executable,
        "landlock_abi": landlock.version(),
        "memory": hierarchy.kind if hierarchy else "watchdog",
        "gpu": list(gpus.gpu_devices(root_plan.real_host())),
    }


def apparmor_profile() -> str:
    """Returns the text for ``/etc/apparmor.d/envhub-worker``, loaded by ``apparmor_parser -r``."""
    return _APPARMOR.format(python=os.path.realpath(sys.executable))


def try_layer(name: str, attempt: Callable[[], str]) -> dict[str, Any]:
    """Run ``attempt`` in a child process; return its result or the reason of its failure."""
    read, write = os.pipe()
    # A process for each layer: what it enters cannot be left again.
    pid = os.fork()
    if pid == 0:
        os.close(read)
        _answer(write, name, attempt)
    os.close(write)
    with open(read, "rb") as answer:
        content = answer.read()
    os.waitpid(pid, 0)
    if content:
        return dict(json.loads(content))
    return _missing(name, "the child that tried was killed", "")


def _answer(write: int, name: str, attempt: Callable[[], str]) -> None:
    try:
        result = {"layer": name, "available": True, "detail": attempt(), "fix": ""}
    except LayerUnavailableError as error:
        result = _missing(name, error.reason, error.fix)
    except OSError as error:
        result = _missing(name, f"the kernel answers {error.strerror}", "")
    os.write(write, json.dumps(result).encode())
    os._exit(0)


def _missing(name: str, detail: str, fix: str) -> dict[str, Any]:
    return {"layer": name, "available": False, "detail": detail, "fix": fix}


def _leave_root() -> str:
    if os.geteuid() != 0:
        return "not needed: already a plain user"
    uid = user.unused_uid()
    user.become(uid)
    return f"can become user {uid}"


def _user_namespace() -> str:
    _leave_root()
    namespaces.enter_user_namespace(os.getuid(), os.getgid())
    return "one user, mapped"


def _namespaces() -> str:
    _user_namespace()
    namespaces.unshare_for_zygote("none")
    namespaces.unshare_for_jail("none")
    return "pid, mount, network, IPC, UTS and cgroup"


def _mounts() -> str:
    _user_namespace()
    namespaces.unshare_for_zygote("none")
    if child := os.fork():  # which answers, as the first process of the new pid namespace
        os.waitpid(child, 0)
        os._exit(0)
    kernel.mount("none", "/", "none", kernel.MS_REC | kernel.MS_PRIVATE)
    kernel.mount("proc", "/proc", "proc", kernel.MS_NOSUID)
    kernel.mount("scratch", "/tmp", "tmpfs", kernel.MS_NODEV, "size=64k")
    tree = kernel.clone_tree("/usr")
    kernel.restrict_tree(tree, kernel.ATTR_RDONLY)
    os.mkdir("/tmp/usr")
    kernel.attach_tree(tree, "/tmp/usr")
    return "tmpfs, proc and read-only binds"


def _copy_on_write() -> str:
    _user_namespace()
    kernel.unshare(kernel.CLONE_NEWNS)
    kernel.mount("none", "/", "none", kernel.MS_REC | kernel.MS_PRIVATE)
    kernel.mount("scratch", "/tmp", "tmpfs", kernel.MS_NODEV, "size=64k")
    for name in ("shared", "written"):
        os.mkdir(f"/tmp/{name}")
    try:
        mounts.mount_overlay("/tmp/shared", ["/tmp/shared"], "/tmp/written")
    except OSError as error:
        raise LayerUnavailableError(
            "copy-on-write",
            f"mounting an overlay answers {error.strerror}",
            "Optional: with Linux 5.11 or later and its overlay module, jails may write beside "
            "the repository's files and packages. Without it they only read these.",
        ) from error
    return "overlays, for the repository and its packages"


def _landlock() -> str:
    process.set_no_new_privileges()
    abi = landlock.version()
    landlock.restrict(landlock.ruleset(abi, "none"), [])
    try:
        os.listdir("/usr")
    except PermissionError:
        return f"ABI {abi}"
    raise LayerUnavailableError("landlock", "a ruleset without rules denies nothing", "")


def _seccomp() -> str:
    process.set_no_new_privileges()
    filter.install(filter.compile_filter(namespaced=True, network="none"))
    try:
        socket.socket(socket.AF_INET)
    except OSError:
        return f"filters for {os.uname().machine}"
    raise LayerUnavailableError("seccomp", "the filter denies nothing", "")


def _capabilities() -> str:
    process.drop_capabilities()
    if process.held_capabilities():
        raise LayerUnavailableError("capabilities", "some could not be dropped", "")
    return "can be dropped"


def _cgroup() -> str:
    hierarchy = cgroups.discover()
    if hierarchy is None:
        raise LayerUnavailableError(
            "cgroup",
            "this user may not make control groups; a watchdog measures memory instead",
            "Optional: start under `systemd-run --user --scope -p Delegate=yes` (cgroup v2), or "
            "as root.",
        )
    tree = cgroups.Tree(hierarchy, "probe")
    tree.remove()
    return hierarchy.kind


_LAYERS: dict[str, Callable[[], str]] = {
    "unprivileged-user": _leave_root,
    "user-namespace": _user_namespace,
    "namespaces": _namespaces,
    "mount-namespace": _mounts,
    "copy-on-write": _copy_on_write,
    "capabilities": _capabilities,
    "landlock": _landlock,
    "seccomp": _seccomp,
    "cgroup": _cgroup,
}


def announcement(surroundings: Surroundings, **more: str) -> str:
    """Returns one line of JSON for the client that started the container. ``more``: further fields
    about a server in it.
    """
    return json.dumps({"envhub-worker": __version__, **vars(surroundings), **more})


def own_runtime() -> Runtime:
    """Returns the jails' default runtime: the environment of a derived image, if it has one."""
    return Runtime(str(ENVIRONMENT)) if ENVIRONMENT.exists() else OWN


def surroundings() -> Surroundings:
    """Returns the confinement around this process, which must be single-threaded."""
    lines = Path("/proc/self/status").read_text().splitlines()
    status = {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}
    sets = ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")
    held = (int(status[name], 16) for name in sets)
    return Surroundings(
        profiles=tuple(profiles(probe()["layers"], landlock.version())),
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

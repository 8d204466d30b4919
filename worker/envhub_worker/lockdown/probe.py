"""Finds out what this host can enforce by trying it in throwaway processes.

``python -I bootstrap.py probe`` prints one JSON object for ``envhub doctor``::

    {"host": {...}, "layers": [{"layer", "available", "detail", "fix"}...],
     "apparmor_profile": text | null}

It tries the layers one by one and lists all missing ones; a jail would stop at the first.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Any

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

"""A jail's own confinement, by its init: what all runners of the jail have in common."""

from __future__ import annotations

import contextlib
import os
import signal

from envhub_worker.lockdown.context import Common
from envhub_worker.lockdown.mechanisms import capabilities, mounts, namespaces, process
from envhub_worker.lockdown.mechanisms.scratch import Scratch
from envhub_worker.lockdown.report import LayerUnavailableError
from envhub_worker.lockdown.root_plan import SHARED_MEMORY, within
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Limits


def enter(spec: JailSpec, common: Common, folder: str) -> tuple[Scratch, str]:
    """Confine this init as far as all of its runners are.

    Args:
        spec: The jail.
        common: What the zygote gives.
        folder: A private folder of the host for a jail without a mount namespace.

    Returns:
        The jail's writable folders, and how the working one shows the snapshot.

    Raises:
        LayerUnavailableError: The host lacks a layer that the profile names.
    """
    if not common.namespaced:
        process.set_no_new_privileges()
        _check_readable(spec)
        process.set_dumpable(False)
        # A container has a /dev/shm of its own; the user's own one is full of other programs'.
        own = spec.confinement.profile == "container"
        return Scratch.on_host(folder, SHARED_MEMORY if own else None), "links"
    try:
        view = _mount(spec, common)
    except OSError as error:
        where = f" at {error.filename}" if error.filename else ""
        raise LayerUnavailableError(
            "mount-namespace", f"{error.strerror}{where}", "This kernel is not supported yet."
        ) from error
    _check_readable(spec)
    _leave_the_zygote()
    return Scratch.in_namespace(), view


def _mount(spec: JailSpec, common: Common) -> str:
    limits = spec.confinement.limits
    _check_snapshot(spec, common)
    namespaces.unshare_for_jail(common.config.network)
    view = mounts.mount_jail(
        spec.snapshot,
        common.roots,
        common.trees,
        size=limits.disk_bytes,
        inodes=limits.disk_files,
    )
    mounts.mount_proc()
    mounts.cover_proc(*common.covered)
    if common.config.network == "loopback":
        namespaces.shrink_tcp()
        namespaces.raise_loopback()
    return view


def _check_snapshot(spec: JailSpec, common: Common) -> None:
    if not any(within(spec.snapshot, path) for path in (*common.roots, *common.trees)):
        raise LayerUnavailableError(
            "mount-namespace",
            f"the snapshot {spec.snapshot} is in none of the readable roots",
            "Start the worker with --readable-root for the folder that snapshots lie in.",
        )


def _check_readable(spec: JailSpec) -> None:
    entry = os.path.join(spec.snapshot, spec.entry)
    if not os.access(entry, os.R_OK):
        raise LayerUnavailableError(
            "unprivileged-user",
            f"the jail's user may not read {entry}",
            "Keep snapshots where other users may read them (ENVHUB_CACHE=/var/cache/envhub), or "
            "start as a plain user.",
        )


def process_limit(limits: Limits, namespaced: bool) -> int:
    """``RLIMIT_NPROC`` of a runner: it counts all of the user's threads in the user namespace."""
    if namespaced:
        return limits.processes + 1  # init
    return limits.processes + _threads_of(os.getuid())


def _threads_of(uid: int) -> int:
    threads = 0
    for name in os.listdir("/proc"):
        with contextlib.suppress(OSError):
            if name.isdigit() and os.stat(f"/proc/{name}").st_uid == uid:
                threads += len(os.listdir(f"/proc/{name}/task"))
    return threads


def _leave_the_zygote() -> None:
    """Own no namespace any more: the next user namespace is below the one that owns them."""
    namespaces.enter_user_namespace(namespaces.INSIDE_UID, namespaces.INSIDE_UID)
    namespaces.forbid_what_is_counted()
    capabilities.drop_all()
    process.set_no_new_privileges()
    process.set_dumpable(False)
    # The change of credentials disarmed it.
    process.die_with_parent(0, signal.SIGKILL)

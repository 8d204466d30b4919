"""The jail's stage of lockdown: init applies the confinement that all its runners share."""

from __future__ import annotations

import contextlib
import errno
import os
import signal

from envhub_worker.lockdown.context import Common
from envhub_worker.lockdown.layers import Layer, LayerUnavailableError
from envhub_worker.lockdown.mechanisms import mounts, namespaces, process, procfs
from envhub_worker.lockdown.mechanisms.mounts import View
from envhub_worker.lockdown.mechanisms.scratch import Scratch
from envhub_worker.lockdown.root_plan import SHARED_MEMORY, within
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Limits


def enter(spec: JailSpec, common: Common, folder: str) -> tuple[Scratch, View]:
    """Apply to this init the confinement that its runners share. Returns the jail's folders and
    view.
    Raises ``LayerUnavailableError``: the host lacks a layer that the profile names.
    ``folder``: a private folder of the host for a jail without a mount namespace.
    """
    # In this order. Without namespaces there is little to do here: this process gives up what it
    # could regain, looks at the entry with the rights that are left, and cannot be traced from then
    # on. Under ``strict`` everything is mounted first, which takes the rights in the user namespace
    # that owns the mounts. The entry is looked at afterwards, as the jail sees it. Then this
    # process leaves for a user namespace below: no process of the jail owns a mount any more, and
    # none can be undone. What the kernel counts is forbidden with the rights that the new namespace
    # gives; only then are these dropped. The change of credentials disarms the signal at the
    # parent's death, so that is set again, last (``_leave_the_zygote``). Runners are forked after
    # all of it.
    if not common.namespaced:
        process.set_no_new_privileges()
        _check_readable(spec)
        process.set_dumpable(False)
        # A container has a /dev/shm of its own; the user's own one is full of other programs'.
        own = spec.confinement.profile == "container"
        why = f"the profile {spec.confinement.profile} mounts nothing"
        view = View({}, {path: why for path in (spec.snapshot, common.config.packages) if path})
        return Scratch.on_host(folder, SHARED_MEMORY if own else None), view
    try:
        view = _mount(spec, common)
    except OSError as error:
        raise _unmountable(error, spec, common) from error
    _check_readable(spec)
    _leave_the_zygote()
    return Scratch.in_namespace(), view


def _mount(spec: JailSpec, common: Common) -> View:
    limits = spec.confinement.limits
    if not any(within(spec.snapshot, path) for path in (*common.root.roots, *common.root.trees)):
        raise LayerUnavailableError(
            "mount-namespace",
            f"the snapshot {spec.snapshot} is in none of the readable roots",
            "Start the worker with --readable-root for the folder with the snapshots.",
        )
    namespaces.unshare_for_jail(common.config.network)
    view = mounts.mount_jail(
        spec.snapshot,
        common.config.packages,
        common.root.roots,
        common.root.trees,
        common.root.links,
        size=limits.disk_bytes,
        inodes=limits.disk_files,
    )
    mounts.mount_proc()
    mounts.cover_proc(*common.covered)
    if common.config.network == "loopback":
        namespaces.shrink_tcp()
        namespaces.raise_loopback()
    return view


def _unmountable(error: OSError, spec: JailSpec, common: Common) -> LayerUnavailableError:
    position = f" at {error.filename}" if error.filename else ""
    shared = {"the snapshot": spec.snapshot, "the folder of packages": common.config.packages}
    for name, path in shared.items():
        if path and not _has_content(path):
            return LayerUnavailableError(
                "mount-namespace",
                f"{name} {path} was removed after this server began to use it",
                "Close the environments that use it and call make_env again, which downloads it "
                "again.",
            )
    if error.errno == errno.ENOSPC:
        return LayerUnavailableError(
            "scratch",
            f"the scratch has no room for the folders of the snapshot{position}",
            "Raise disk_files or disk_bytes of the limits.",
        )
    return LayerUnavailableError(
        "mount-namespace",
        f"{error.strerror}{position}",
        "Please report this with the output of `envhub doctor --json`.",
    )


def _has_content(folder: str) -> bool:
    with contextlib.suppress(OSError):
        return bool(os.listdir(folder))
    return False


def working_view(view: View) -> Layer:
    """Returns the layer, for the report, that says how a jail sees shared files."""
    detail = "the repository and its packages, copy on write: changes go to the scratch"
    if view.refused:
        path, why = next(iter(view.refused.items()))
        detail = f"links into the repository; {path} is read-only: {why}"
    return Layer("working-view", True, detail)


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
    """Returns a runner's ``RLIMIT_NPROC``; it counts the user's threads in the user namespace."""
    if namespaced:
        return limits.processes + 1  # init
    threads = 0
    for pid in procfs.pids():
        with contextlib.suppress(OSError):
            if os.stat(f"/proc/{pid}").st_uid == os.getuid():
                threads += len(os.listdir(f"/proc/{pid}/task"))
    return limits.processes + threads


def _leave_the_zygote() -> None:
    """Give up the zygote's namespaces by entering a user namespace below the one that owns them."""
    namespaces.enter_user_namespace(namespaces.INSIDE_UID, namespaces.INSIDE_UID)
    namespaces.forbid_what_is_counted()
    process.drop_capabilities()
    process.set_no_new_privileges()
    process.set_dumpable(False)
    # The change of credentials has cleared the parent-death signal.
    process.die_with_parent(0, signal.SIGKILL)

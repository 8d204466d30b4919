"""The runner's stage of lockdown: confinement that the kernel binds to a process and its
descendants.

It ends with a self-test, the last step before a stranger's code: the runner tries everything that
it must not be able to do.
"""

from __future__ import annotations

import contextlib
import os
import resource
import secrets
import socket
from collections.abc import Callable, Iterable
from functools import partial

from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import kernel, landlock, process
from envhub_worker.lockdown.mechanisms.landlock import LandlockRule
from envhub_worker.lockdown.root_plan import TERMINALS
from envhub_worker.lockdown.seccomp import filter
from envhub_worker.protocol.confinement import Limits

# Files that the C library and numerical libraries read. None of them tells about a person.
_HOST_FILES = (
    "/etc/alternatives",
    "/etc/fonts",
    "/etc/group",
    "/etc/host.conf",
    "/etc/hosts",
    "/etc/ld.so.cache",
    "/etc/localtime",
    "/etc/mime.types",
    "/etc/nsswitch.conf",
    "/etc/passwd",
    "/etc/pki/tls/certs",
    "/etc/ssl/certs",  # clients of the Hub read public certificates before they see it is offline
    "/etc/ssl/openssl.cnf",
    "/proc/cpuinfo",
    "/proc/filesystems",
    "/proc/meminfo",
    "/proc/stat",
    "/proc/sys/kernel",
    "/proc/sys/vm/overcommit_memory",
    "/proc/uptime",
    "/proc/version",
)
# Readable entries of a process's own folder in /proc. net is missing, and task, which contains net:
# without a network namespace net lists the connections, neighbours and socket files of the host.
_OWN_FILES = """
    auxv cgroup cmdline comm environ fd fdinfo io limits maps mem mountinfo mounts oom_score
    oom_score_adj smaps smaps_rollup stat statm status
"""

# Signals in the queue and armed timers: the kernel counts them per user, and answers the user's
# other programs EAGAIN at their own limit, some tens of thousands.
_SIGNALS = 512

# The kernel sends SIGXCPU at the soft limit and SIGKILL at the hard one; the second in between
# lets the process print where it was.
_CPU_GRACE_S = 1

_PTRACE_ATTACH = 16


def enter(
    jail: JailContext, descriptors: Iterable[int], give_to_init: Callable[[int], None]
) -> None:
    """Confine this single-threaded process for good, and test that it holds.
    Raises ``LayerUnavailableError``: the host lacks a layer, or a denial does not hold.

    Args:
        descriptors: Every descriptor that may be open.
        give_to_init: Takes the broker's listener, if there is one, before the descriptor is closed.
    """
    # In this order. Dumpable comes first: init is not, but a process that is not may not even open
    # its own files in /proc, which the next line does. Limits come before the capabilities go that
    # could raise them, and the capabilities before no_new_privs, which Landlock and seccomp need
    # from a process without privileges. Landlock needs system calls that the filter denies, so the
    # filter is last: from then on each call is judged, the self-test's own included. The self-test
    # sees what a stranger's code would see, for nothing is given up after it.
    process.set_dumpable(True)
    # when the whole host runs out of memory, the kernel should end a jail, not its client
    with open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")
    process.apply_limits(resource_limits(jail.spec.confinement.limits, jail.processes))
    process.drop_capabilities()
    process.set_no_new_privileges()
    if jail.common.landlock_abi:
        ruleset = landlock.ruleset(jail.common.landlock_abi, jail.common.config.network)
        landlock.restrict(ruleset, rules(jail, os.getpid()))
    program = jail.common.programs[jail.measured]
    asks = jail.common.brokered or jail.common.config.record
    listener = filter.install(program, brokered=asks)
    if listener >= 0:
        give_to_init(listener)
        os.close(listener)  # its holder may permit anything
    _self_test(jail, descriptors)


def rules(jail: JailContext, pid: int) -> list[LandlockRule]:
    """Returns the Landlock rules of a runner; everything else is denied.
    ``pid``: the runner's pid; without a pid namespace it may read only its own ``/proc`` folder.
    """
    common = jail.common
    readable = [*common.root.trees, jail.spec.snapshot]
    own = f"/proc/{pid}"
    own_files = [f"{own}/{name}" for name in _OWN_FILES.split()]
    readable += ["/proc", "/etc", "/dev"] if common.namespaced else [*_HOST_FILES, *own_files]
    writable = writable_folders(jail)
    # CUDA writes thread names there and fails (error 304) if it cannot. With a pid namespace, /proc
    # has the jail's processes only. Without one the runner may write below its own folder only, so
    # child processes cannot name their threads.
    devices = [*common.root.devices, *([TERMINALS] if common.namespaced else [])]
    threads = (
        [] if common.config.gpu is False else ["/proc" if common.namespaced else f"{own}/task"]
    )
    return [
        *(LandlockRule(path, landlock.READ) for path in readable),
        *([] if common.namespaced else [LandlockRule(own, landlock.READ_DIR)]),
        *(LandlockRule(path, landlock.WRITE) for path in writable),
        *(LandlockRule(path, landlock.DEVICE) for path in devices),
        *(LandlockRule(path, landlock.WRITE_FILE | landlock.TRUNCATE) for path in threads),
    ]


def writable_folders(jail: JailContext) -> list[str]:
    """Returns the folders that the processes of a jail may write."""
    scratch = jail.scratch
    shared = [] if scratch.shared_memory is None else [scratch.shared_memory]
    return [scratch.home, scratch.temporary, scratch.work, *shared, *jail.view.shared]


def resource_limits(limits: Limits, processes: int | None) -> dict[int, tuple[int, int]]:
    """Returns the (soft, hard) limits by resource number.
    ``processes``: cap for ``RLIMIT_NPROC``, or None if it would count other programs' threads.
    """
    file_bytes = limits.disk_bytes if limits.file_bytes is None else limits.file_bytes
    rules = {
        resource.RLIMIT_CORE: (0, 0),
        resource.RLIMIT_FSIZE: (file_bytes, file_bytes),
        resource.RLIMIT_NOFILE: (limits.open_files, limits.open_files),
        resource.RLIMIT_MEMLOCK: (64 * 1024, 64 * 1024),
        resource.RLIMIT_MSGQUEUE: (0, 0),
        resource.RLIMIT_NICE: (0, 0),
        resource.RLIMIT_SIGPENDING: (_SIGNALS, _SIGNALS),
        resource.RLIMIT_RTPRIO: (0, 0),
    }
    if processes is not None:
        rules[resource.RLIMIT_NPROC] = (processes, processes)
    if limits.cpu_time_s is not None:
        rules[resource.RLIMIT_CPU] = (limits.cpu_time_s, limits.cpu_time_s + _CPU_GRACE_S)
    return rules


def _self_test(jail: JailContext, descriptors: Iterable[int]) -> None:
    """Try every harmless action that a runner must not be able to do.
    Raises ``LayerUnavailableError``: layer ``self-test``: a denial does not hold.
    """
    _hold("no capability is left", process.held_capabilities() == 0)
    _hold("no_new_privs is set", process.has_no_new_privileges())
    _hold("a system call filter is installed", filter.installed())
    for path, shared in jail.view.shared.items():
        _hold(f"what is written to {path} stays in the jail", _stays_inside(path, shared))
    listed = [int(name) for name in os.listdir("/proc/self/fd")]  # with the listing's own
    still_open = {fd for fd in listed if not _denied(partial(os.fstat, fd))}
    _hold("only named descriptors are open", still_open <= set(descriptors))
    for claim, attempt in _denials(jail).items():
        _hold(claim, _denied(attempt))


def _denials(jail: JailContext) -> dict[str, Callable[[], object]]:
    init = os.getppid()
    denials: dict[str, Callable[[], object]] = {
        "no user namespace can be made": partial(kernel.unshare, kernel.CLONE_NEWUSER),
        "nothing can be mounted": partial(kernel.mount, "none", "/tmp", "tmpfs"),
        "init cannot be traced": partial(kernel.syscall, "ptrace", _PTRACE_ATTACH, init, 0, 0),
        "init's limits cannot be changed": partial(
            kernel.syscall, "prlimit64", init, resource.RLIMIT_CORE, 0, 0
        ),
    }
    if jail.spec.snapshot in jail.view.refused:
        entry = os.path.join(jail.spec.snapshot, jail.spec.entry)
        denials["the snapshot cannot be written"] = partial(os.open, entry, os.O_WRONLY)
    for path in jail.view.refused:
        denials[f"{path} cannot be written"] = partial(_make_unnamed, path)
    if jail.common.landlock_abi or jail.common.namespaced:
        canary = jail.common.config.canary
        denials["files outside cannot be read"] = partial(os.open, canary, os.O_RDONLY)
    if landlock.scopes(jail.common.landlock_abi) or jail.common.brokered:
        denials["init cannot be signalled"] = partial(os.kill, init, 0)
    if jail.common.config.network == "none":
        denials["no internet socket can be made"] = partial(socket.socket, socket.AF_INET)
    return denials


def _make_unnamed(path: str, folder: int | None = None) -> None:
    """Try to create a file without a name, which the kernel removes at once."""
    os.open(path, os.O_TMPFILE | os.O_WRONLY, 0o600, dir_fd=folder)


def _stays_inside(path: str, shared: int) -> bool:
    """Whether a new file in a view does not appear in the folder ``shared``, which is read-only."""
    name = f".{secrets.token_hex(16)}"
    try:
        with contextlib.suppress(OSError):  # where a runner before filled the scratch, for example
            os.close(os.open(f"{path}/{name}", os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        return not _is_there(name, shared) and _denied(partial(_make_unnamed, ".", shared))
    finally:
        with contextlib.suppress(OSError):
            os.unlink(f"{path}/{name}")
        os.close(shared)  # nothing but this test looks below a view


def _is_there(name: str, folder: int) -> bool:
    try:
        os.lstat(name, dir_fd=folder)
    except FileNotFoundError:
        return False
    return True


def _denied(attempt: Callable[[], object]) -> bool:
    try:
        attempt()
    except OSError:
        return True
    return False


def _hold(claim: str, holds: bool) -> None:
    if not holds:
        raise LayerUnavailableError(
            "self-test",
            f"this is not true: {claim}",
            "Nothing was run. Please report this with the output of `envhub doctor --json`.",
        )

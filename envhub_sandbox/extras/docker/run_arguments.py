"""Builds the command line that starts a container, and its system call profile. Pure.

The profile is an allow-list, like the engines' default, which denies calls that reach the kernel's
internals. It differs in two ways. It permits the calls by which the worker locks down jails:
Landlock, their own filters, namespaces, and mounts inside a user namespace. The default denies or
does not know these. And it denies calls that the default permits, but neither the worker nor a jail
needs: tracing, reading other processes' memory, other address families, the other word size. The
worker adds a filter for each jail.
"""

from __future__ import annotations

import errno
import platform
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy

CLIENT_LABEL = "dev.envhub.client"
"""The client's pid in the client's own pid namespace, for people to read."""
FOLDER_LABEL = "dev.envhub.folder"
"""The client's runtime folder, which is in use as long as the client lives."""
USER_LABEL = "dev.envhub.user"
"""The user id of the client."""

SOCKETS = "/run/envhub"
"""The folder of mode 0700 that client and server share: their only channel."""
SNAPSHOTS = "/snapshots"
SNAPSHOT = f"{SNAPSHOTS}/this"
"""The folder of the repository's files in the container, which does not learn the host's path."""
PACKAGES = "/packages"
"""The folder in the container of the packages that were made for the repository."""
PORT = 5555
"""The port in the container of a server whose port is published."""
IMAGE_USER = 65532
"""The image's own user, who owns ``STATE``."""
STATE = "/var/lib/envhub-worker"
"""The folder in the container where a server with a published port stores uploads."""

_MIB = 1024 * 1024
_OVERHEAD_BYTES = 1024 * _MIB
_OVERHEAD_PIDS = 256
_SHARED_MEMORY_BYTES = 1024 * _MIB
# The container's own top-level folders. A path of the host mounted on one would replace it.
_OWN = frozenset(
    {
        *("bin", "dev", "etc", "lib", "lib32", "lib64", "libx32", "opt", "packages", "proc"),
        *("root", "run", "sbin", "snapshots", "sys", "tmp", "usr", "var"),
    }
)


@dataclass(frozen=True, kw_only=True)
class Container:
    """The requested properties of a container.

    Attributes:
        image: The image's id.
        sockets: The host's folder that is mounted at ``SOCKETS``.
        snapshot: The host's folder that is mounted at ``SNAPSHOT``, read-only.
        packages: The host's folder that is mounted at ``PACKAGES``, read-only, or empty.
        assets: The host's folders of further repositories, mounted read-only beside ``SNAPSHOT``.
        readable: Further paths of the host, mounted read-only at the same paths.
        seccomp: The host's path of the system call profile.
        network: ``"none"`` or ``"host"``.
        memory: The limit in bytes without swap, or None if the engine cannot set it.
        pids: The limit of processes and threads, or None if the engine cannot set it.
        cpus: The limit of CPUs, or None if the engine cannot set it.
        scratch: Bytes of /tmp.
        runtime: The engine's runtime, or None for its default.
        gpus: The value of ``--gpus``, or None.
        ulimits: The values of ``--ulimit``, besides the one that forbids core dumps.
        only_client: The client's public key, as text, if the server's port is published on
            loopback. Then no file of the host is mounted; ``sockets`` and ``snapshot`` are empty.
        profile: The weakest profile that a server with a published port permits.
    """

    name: str
    image: str
    labels: dict[str, str]
    sockets: str
    snapshot: str
    readable: tuple[str, ...]
    seccomp: str
    user: tuple[int, int]
    network: str
    memory: int | None
    pids: int | None
    cpus: float | None
    scratch: int
    runtime: str | None
    gpus: str | None
    ulimits: tuple[str, ...] = ()
    packages: str = ""
    assets: tuple[str, ...] = ()
    only_client: str = ""
    profile: str = "strict"


def run_arguments(engine: Engine, wanted: Container) -> list[str]:
    """Return the arguments of the engine's command."""
    return [
        *("run", "--rm", "--interactive", "--pull", "never", "--log-driver", "none"),
        *("--no-healthcheck", "--name", wanted.name, "--hostname", "sandbox", "--workdir", "/"),
        *(word for name, value in wanted.labels.items() for word in ("--label", f"{name}={value}")),
        *_confinement(engine, wanted),
        *_limits(wanted),
        *_files(wanted),
        *_devices(engine, wanted),
        *([] if wanted.runtime is None else ["--runtime", wanted.runtime]),
        wanted.image,
        *(_listen(wanted) if wanted.only_client else _serve()),
        *("--until-eof", "--announce"),
    ]


def _serve() -> list[str]:
    return [
        *("serve", "--endpoint", f"ipc://{SOCKETS}/server", "--fd-path", f"{SOCKETS}/fds"),
        *("--runtime-dir", "/tmp/envhub-worker", "--readable-root", SNAPSHOTS),
    ]


def _listen(wanted: Container) -> list[str]:
    return [
        *("listen", "--bind", f"tcp://0.0.0.0:{PORT}", "--only-client", wanted.only_client),
        *("--log-level", "warning"),
        # "strict" is the default; without Landlock the caller may choose a weaker profile
        *(["--weakest-profile", wanted.profile] if wanted.profile != "strict" else []),
        *(["--allow-network"] if wanted.network == "host" else []),
        *(["--allow-gpu"] if wanted.gpus is not None else []),
    ]


def _confinement(engine: Engine, wanted: Container) -> list[str]:
    user, group = wanted.user
    podman = engine.kind == "podman"
    # The kernel lets a jail mount its own /proc only if an unmasked one is visible. The masks would
    # hide files of root, which no process in here can become; jails see none of them.
    unmasked = "unmask=ALL" if podman else "systempaths=unconfined"
    words = ["--network", wanted.network, "--read-only", "--cap-drop", "ALL"]
    if wanted.only_client:  # a port needs a network
        words[1:2] = ["bridge", "--publish", f"127.0.0.1::{PORT}"]
    words += ["--security-opt", "no-new-privileges", "--security-opt", f"seccomp={wanted.seccomp}"]
    words += ["--security-opt", unmasked, "--ipc", "private", "--user", f"{user}:{group}"]
    if podman:
        words.append("--read-only-tmpfs=false")
        if engine.rootless and not wanted.only_client:
            words += ["--userns", "keep-id"]
    elif engine.remapped:
        words += ["--userns", "host"]
    return words


def _limits(wanted: Container) -> list[str]:
    limits = ("core=0:0", *wanted.ulimits)
    words = [word for limit in limits for word in ("--ulimit", limit)]
    if wanted.memory is not None:
        words += ["--memory", str(wanted.memory), "--memory-swap", str(wanted.memory)]
    if wanted.pids is not None:
        words += ["--pids-limit", str(wanted.pids)]
    if wanted.cpus is not None:
        words += ["--cpus", f"{wanted.cpus:g}"]
    if wanted.memory is wanted.pids is wanted.cpus is None:
        words.append("--cgroups=disabled")
    return words


def _files(wanted: Container) -> list[str]:
    scratch = f"rw,nosuid,nodev,size={wanted.scratch},mode=1777"
    own = ["--tmpfs", f"/tmp:{scratch}", "--shm-size", str(_SHARED_MEMORY_BYTES)]
    if wanted.only_client:
        return [*own, "--mount", f"type=volume,dst={STATE}"]  # unnamed: --rm removes it
    mounts = [
        _mount(wanted.sockets, SOCKETS, read_only=False),
        _mount(wanted.snapshot, SNAPSHOT, read_only=True),
        *([_mount(wanted.packages, PACKAGES, read_only=True)] if wanted.packages else []),
        *(_mount(path, place, read_only=True) for path, place in asset_places(wanted.assets)),
        *(_mount(path, path, read_only=True) for path in wanted.readable),
    ]
    return [*own, *(word for mount in mounts for word in ("--mount", mount))]


def asset_places(assets: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Return each asset's folder on the host, and its folder in the container."""
    return ((path, f"{SNAPSHOTS}/asset-{number}") for number, path in enumerate(assets))


def _mount(source: str, target: str, *, read_only: bool) -> str:
    # quote each value as in CSV, so that a comma or a quote in a path separates nothing
    values = ["type=bind", f"src={source}", f"dst={target}", *(["readonly"] if read_only else [])]
    quoted = ['"' + value.replace('"', '""') + '"' for value in values]
    return ",".join(quoted)


def _devices(engine: Engine, wanted: Container) -> list[str]:
    if wanted.gpus is None:
        return []
    if engine.kind == "podman":
        return ["--device", f"nvidia.com/gpu={wanted.gpus}"]
    return ["--gpus", wanted.gpus]


def memory_for(policy: Policy) -> int:
    """Return the bytes for one jail at its limit and for the server."""
    return policy.limits.memory_bytes + _OVERHEAD_BYTES


def pids_for(policy: Policy) -> int:
    """Return the number of processes for one jail at its limit and for the server."""
    return policy.limits.processes + _OVERHEAD_PIDS


def scratch_for(policy: Policy) -> int:
    """Return the bytes of /tmp, which has the scratch of a jail without its own file system."""
    return policy.limits.disk_bytes + 64 * _MIB


def check_readable(paths: tuple[str, ...]) -> None:
    """Raise ``PolicyError`` if a path would replace the container's own files."""
    for path in paths:
        parts = [part for part in path.split("/") if part]
        if ".." in parts or not parts or (len(parts) == 1 and parts[0] in _OWN):
            raise PolicyError(
                f"{option_name('readable')} has {path!r}, which a container replaces by its own; "
                "name the paths below it that are needed"
            )


#: For each machine name of ``os.uname`` the name in a profile.
ARCHITECTURES = {"x86_64": "SCMP_ARCH_X86_64", "aarch64": "SCMP_ARCH_AARCH64"}
_OTHER_NAMES = {"amd64": "x86_64", "arm64": "aarch64"}
"""For each of the engines' machine names the name of ``os.uname``."""

_MEMORY = """
    brk get_mempolicy madvise mbind membarrier memfd_create mincore mlock mlock2 mlockall mmap
    mprotect mremap mseal msync munlock munlockall munmap pkey_alloc pkey_free pkey_mprotect
    set_mempolicy
"""
_FILES = """
    access chdir chmod chown close close_range copy_file_range creat dup dup2 dup3 epoll_create
    epoll_create1 epoll_ctl epoll_pwait epoll_pwait2 epoll_wait eventfd eventfd2 faccessat
    faccessat2 fadvise64 fallocate fchdir fchmod fchmodat fchmodat2 fchown fchownat fcntl
    fdatasync fgetxattr flistxattr flock fremovexattr fsetxattr fstat fstatfs fsync ftruncate
    futimesat getcwd getdents getdents64 getxattr inotify_add_watch inotify_init inotify_init1
    inotify_rm_watch ioctl lchown lgetxattr link linkat listxattr llistxattr lremovexattr lseek
    lsetxattr lstat mkdir mkdirat mknod mknodat newfstatat open openat openat2 pipe pipe2 poll ppoll
    pread64 preadv preadv2 pselect6 pwrite64 pwritev pwritev2 read readahead readlink readlinkat
    readv removexattr rename renameat renameat2 rmdir select sendfile setxattr signalfd signalfd4
    splice stat statfs statx symlink symlinkat sync sync_file_range syncfs tee timerfd_create
    timerfd_gettime timerfd_settime truncate umask unlink unlinkat utime utimensat utimes write
    writev
"""
_PROCESSES = """
    alarm arch_prctl capget capset clock_getres clock_gettime clock_nanosleep clone execve
    execveat exit exit_group fork futex futex_requeue futex_wait futex_waitv futex_wake
    get_robust_list get_thread_area getcpu getegid geteuid getgid getgroups getitimer getpgid
    getpgrp getpid getppid getpriority getrandom getresgid getresuid getrlimit getrusage getsid
    gettid gettimeofday getuid ioprio_get nanosleep pause pidfd_open pidfd_send_signal prctl
    prlimit64 restart_syscall rseq sched_get_priority_max sched_get_priority_min
    sched_getaffinity sched_getattr sched_getparam sched_getscheduler sched_rr_get_interval
    sched_setaffinity sched_setattr sched_setparam sched_setscheduler sched_yield
    set_robust_list set_thread_area set_tid_address setfsgid setfsuid setgid setgroups setitimer
    setpgid setpriority setregid setresgid setresuid setreuid setrlimit setsid setuid sysinfo
    time timer_create timer_delete timer_getoverrun timer_gettime timer_settime times uname
    vfork wait4 waitid
"""
_SIGNALS = """
    kill rt_sigaction rt_sigpending rt_sigprocmask rt_sigqueueinfo rt_sigreturn rt_sigsuspend
    rt_sigtimedwait rt_tgsigqueueinfo sigaltstack tgkill tkill
"""
_SOCKETS = """
    accept accept4 bind connect getpeername getsockname getsockopt listen recvfrom recvmmsg recvmsg
    sendmmsg sendmsg sendto setsockopt shutdown
"""
_SYSTEM_V = """
    mq_getsetattr mq_notify mq_open mq_timedreceive mq_timedsend mq_unlink msgctl msgget msgrcv
    msgsnd semctl semget semop semtimedop shmat shmctl shmdt shmget
"""
# Calls that lock down a jail. Outside a user namespace most need capabilities, which are dropped.
_LOCKDOWN = """
    landlock_add_rule landlock_create_ruleset landlock_restrict_self mount mount_setattr move_mount
    open_tree pivot_root seccomp sethostname setns umount2 unshare
"""
ALLOWED = frozenset(
    " ".join((_MEMORY, _FILES, _PROCESSES, _SIGNALS, _SOCKETS, _SYSTEM_V, _LOCKDOWN)).split()
)
"""Calls that are permitted with any arguments."""

FAMILIES = {"AF_UNIX": 1, "AF_INET": 2, "AF_INET6": 10, "AF_NETLINK": 16}
_PERSONALITIES = (0, 0xFFFFFFFF)


def seccomp_profile(machine: str | None = None) -> dict[str, Any]:
    """Return the profile in the form that docker and podman read.
    ``machine``: its name as in ``os.uname``; by default this machine.
    Raises ``SandboxUnavailableError``: there is no profile for the machine.
    """
    machine = machine or platform.machine()
    machine = _OTHER_NAMES.get(machine.lower(), machine)
    if machine not in ARCHITECTURES:
        raise SandboxUnavailableError(
            f"there is no system call profile for {machine}; containers run on x86-64 and aarch64"
        )
    return {
        "defaultAction": "SCMP_ACT_ERRNO",
        "defaultErrnoRet": errno.EPERM,
        # only the native word size: calls of another one would bypass the filter
        "architectures": [ARCHITECTURES[machine]],
        "syscalls": [
            {"names": sorted(ALLOWED), "action": "SCMP_ACT_ALLOW"},
            *(_only(("socket", "socketpair"), family) for family in FAMILIES.values()),
            *(_only(("personality",), value) for value in _PERSONALITIES),
            # no filter can read clone3's flags in memory; the C library falls back to clone
            {"names": ["clone3"], "action": "SCMP_ACT_ERRNO", "errnoRet": errno.ENOSYS},
        ],
    }


def _only(names: tuple[str, ...], value: int) -> dict[str, Any]:
    check = {"index": 0, "value": value, "op": "SCMP_CMP_EQ"}
    return {"names": list(names), "action": "SCMP_ACT_ALLOW", "args": [check]}

"""The system calls of a container that runs ``envhub-worker``, as an engine's JSON profile.

It starts from the idea of the engines' default profile, an allow-list that denies whatever reaches
the kernel's innards, and differs in two ways. It permits what the worker needs to lock its jails
down (Landlock, filters of their own, namespaces and mounts inside of a user namespace), which the
default either denies or has not heard of. And it denies what neither the worker nor a jail ever
calls, though the default permits it: tracing, reading other processes' memory, other address
families, the other word size. A jail's own filter, which the worker installs, lies within.
"""

from __future__ import annotations

import errno
import platform
from typing import Any

from envhub_sandbox.errors import SandboxUnavailableError

#: What ``os.uname`` calls a machine, and what a profile calls it.
ARCHITECTURES = {"x86_64": "SCMP_ARCH_X86_64", "aarch64": "SCMP_ARCH_AARCH64"}
_OTHER_NAMES = {"amd64": "x86_64", "arm64": "aarch64"}
"""As engines have them."""

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
# What locks a jail down. Outside of a user namespace these need capabilities, which none here has.
_LOCKDOWN = """
    landlock_add_rule landlock_create_ruleset landlock_restrict_self mount mount_setattr move_mount
    open_tree pivot_root seccomp sethostname setns umount2 unshare
"""
ALLOWED = frozenset(
    " ".join((_MEMORY, _FILES, _PROCESSES, _SIGNALS, _SOCKETS, _SYSTEM_V, _LOCKDOWN)).split()
)
"""Calls that are permitted whatever their arguments."""

FAMILIES = {"AF_UNIX": 1, "AF_INET": 2, "AF_INET6": 10, "AF_NETLINK": 16}
_PERSONALITIES = (0, 0xFFFFFFFF)


def profile(machine: str | None = None) -> dict[str, Any]:
    """The profile, in the form that docker and podman read. ``machine``: as ``os.uname`` says it;
    default: this one.
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
        # only the native one: the calls of another word size are ways around every filter
        "architectures": [ARCHITECTURES[machine]],
        "syscalls": [
            {"names": sorted(ALLOWED), "action": "SCMP_ACT_ALLOW"},
            *(_only(("socket", "socketpair"), family) for family in FAMILIES.values()),
            *(_only(("personality",), value) for value in _PERSONALITIES),
            # its flags lie in memory, where no filter can look; the C library falls back to clone
            {"names": ["clone3"], "action": "SCMP_ACT_ERRNO", "errnoRet": errno.ENOSYS},
        ],
    }


def _only(names: tuple[str, ...], value: int) -> dict[str, Any]:
    check = {"index": 0, "value": value, "op": "SCMP_CMP_EQ"}
    return {"names": list(names), "action": "SCMP_ACT_ALLOW", "args": [check]}

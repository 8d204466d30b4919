"""The system calls that a jail may make: a table for each profile. Pure.

The table is an allow-list. A call that ``syscalls`` knows but the table lacks fails with EPERM; an
unknown call fails with ENOSYS, so that programs fall back. Some library needs each call here:
``python -m tests.field`` runs the packages of the field and reports their calls.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Mapping

from envhub_worker.lockdown.seccomp.syscalls import NAMED, NAMING, PRETENDED
from envhub_worker.protocol.records import dataclass

_ERRNO = 0x00050000
ALLOW = 0x7FFF0000
KILL_PROCESS = 0x80000000
#: Init answers the call (``SECCOMP_RET_USER_NOTIF``).
ASK = 0x7FC00000
EPERM = _ERRNO | errno.EPERM
ENOSYS = _ERRNO | errno.ENOSYS
EINVAL = _ERRNO | errno.EINVAL
#: The call does nothing and succeeds: an error would make libraries abort, or give up a copy.
PRETEND = _ERRNO | 0


@dataclass(frozen=True)
class Check:
    """A test of ``(args[arg] & mask) == value``: of all 64 bits if ``wide``, else the low 32."""

    arg: int
    value: int
    mask: int = 0xFFFFFFFF
    wide: bool = False


@dataclass(frozen=True)
class ByArguments:
    """A verdict by arguments: of the first rule whose checks all hold, else ``otherwise``."""

    rules: Rules
    otherwise: int


Rules = tuple[tuple[tuple[Check, ...], int], ...]
Verdict = int | ByArguments

_MEMORY = """
    brk munmap mremap mprotect madvise mincore msync mlock munlock membarrier memfd_create
    get_mempolicy
"""
_FILES = """
    read write pread64 pwrite64 readv writev preadv pwritev preadv2 pwritev2 open openat creat
    close close_range lseek stat lstat fstat newfstatat statx access faccessat faccessat2 getdents
    getdents64 getcwd chdir fchdir mkdir mkdirat rmdir unlink unlinkat rename renameat renameat2
    link linkat symlink symlinkat readlink readlinkat truncate ftruncate fallocate fadvise64
    copy_file_range sendfile dup dup2 dup3 flock fsync fdatasync statfs fstatfs umask getxattr
    lgetxattr fgetxattr listxattr llistxattr flistxattr pipe pipe2 eventfd2 timerfd_create
    timerfd_settime timerfd_gettime epoll_create epoll_create1 epoll_ctl epoll_wait epoll_pwait
    poll ppoll select pselect6
"""
_PROCESSES = """
    fork vfork execve exit exit_group wait4 waitid getpid getppid gettid getpgid getpgrp getsid
    setsid setpgid getuid geteuid getgid getegid getresuid getresgid getgroups capget
    set_tid_address set_robust_list rseq restart_syscall futex sched_yield sched_getaffinity
    sched_getparam sched_getscheduler sched_getattr sched_get_priority_max
    sched_get_priority_min sched_rr_get_interval getcpu getpriority ioprio_get getrlimit
    setrlimit getrusage times sysinfo uname alarm pause nanosleep clock_nanosleep clock_gettime
    clock_getres gettimeofday time getitimer setitimer timer_create timer_settime timer_gettime
    timer_getoverrun timer_delete pidfd_open getrandom
"""
_SIGNALS = """
    kill tkill tgkill rt_sigaction rt_sigprocmask rt_sigreturn rt_sigpending rt_sigsuspend
    rt_sigtimedwait sigaltstack pidfd_send_signal
"""
_CONNECTED_SOCKETS = """
    getsockname getpeername sendmsg sendmmsg recvfrom recvmsg recvmmsg getsockopt shutdown
"""
_OTHER_SOCKETS = "bind listen accept accept4 connect"
# Landlock does not restrict these, so they need a mount and an IPC namespace.
_MODES_AND_TIMES = "chmod fchmod fchmodat fchmodat2 chown fchown lchown fchownat utimensat"
_NAMESPACED = f"""
    {_MODES_AND_TIMES} sched_setaffinity removexattr lremovexattr fremovexattr
"""
#: These fail as on a file system without attributes. Access lists take 128 KiB of kernel memory per
#: file, which no control group counts; programs that copy a file work without them.
WITHOUT_ATTRIBUTES = frozenset(("setxattr", "lsetxattr", "fsetxattr"))
# These succeed and do nothing: a jail has one user, libzmq aborts if it cannot set the scheduler,
# and syncing stalls the host's disks. The last three are the predecessors of utimensat.
_WITHOUT_EFFECT = """
    setuid setgid setreuid setregid setresuid setresgid sched_setscheduler sched_setparam
    sched_setattr sync syncfs sync_file_range readahead utime utimes futimesat
"""
# Programs work without these, which some kernels lack. The first three lines take kernel memory
# that is counted per user or not at all (watches of files also tell which files others open).
# Memory policies (mbind) are not in the table either.
_ABSENT = """
    inotify_init inotify_init1 inotify_add_watch inotify_rm_watch
    semget semop semtimedop semctl msgget msgsnd msgrcv msgctl shmget shmat shmctl shmdt
    mq_open mq_unlink mq_timedsend mq_timedreceive mq_notify mq_getsetattr
    openat2 execveat splice tee signalfd signalfd4 eventfd epoll_pwait2 mlock2 mseal
    pkey_alloc pkey_free pkey_mprotect futex_waitv futex_wake futex_wait futex_requeue
"""

#: Maximum size of shared memory without a name if init measures memory.
SHARED_BYTES = 1 << 20

_NAMESPACES = 0x7E020000  # every CLONE_NEW* that clone takes
_S_IFMT, _S_IFIFO = 0o170000, 0o010000
_AF_UNIX, _AF_INET, _AF_INET6, _AF_NETLINK = 1, 2, 10, 16
_NETLINK_ROUTE, _NETLINK_KOBJECT_UEVENT = 0, 15
_SOCK_STREAM, _SOCK_DGRAM, _SOCK_RAW, _SOCK_SEQPACKET, _SOCK_TYPE = 1, 2, 3, 5, 0xF
_EAFNOSUPPORT = _ERRNO | errno.EAFNOSUPPORT
_ENOTTY = _ERRNO | errno.ENOTTY
_ENOMEM = _ERRNO | errno.ENOMEM
_ENOTSUP = _ERRNO | errno.ENOTSUP
_TIOCSTI, _TIOCLINUX, _TIOCCONS, _TIOCSETD = 0x5412, 0x541C, 0x541D, 0x5423
_FIOSETOWN, _SIOCSPGRP = 0x8901, 0x8902
# Operations of fcntl: duplicates, flags, locks, signal owners, pipe sizes, seals, reading hints.
_FCNTLS = (*range(8), 9, 11, 16, 36, 37, 38, 1025, 1027, 1028, 1030, 1032, 1033, 1034, 1035, 1037)
_F_SETOWN, _F_SETSIG, _F_SETOWN_EX, _F_SETLEASE, _F_NOTIFY = 8, 10, 15, 1024, 1026
_F_SETPIPE_SZ, _F_SET_RW_HINT, _F_SET_FILE_RW_HINT, _F_SETDELEG = 1031, 1036, 1038, 1040
_MAP_SHARED, _MAP_ANONYMOUS, _MAP_HUGETLB = 0x1, 0x20, 0x40000
# No process's memory count includes reserved huge pages (MAP_HUGETLB).
_HUGE = (((Check(3, _MAP_HUGETLB, _MAP_HUGETLB),), _ENOMEM),)
_SOL_SOCKET = 1
_SO_SNDBUF, _SO_RCVBUF, _SO_SNDBUFFORCE, _SO_RCVBUFFORCE = 7, 8, 32, 33
_SO_ATTACH_FILTER, _SO_ATTACH_BPF, _SO_ATTACH_CBPF, _SO_ATTACH_EBPF = 26, 50, 51, 52
# PR_SET_PDEATHSIG, _NAME, _TIMERSLACK, _CHILD_SUBREAPER and _NO_NEW_PRIVS, and reading options.
_PRCTLS = (1, 2, 3, 15, 16, 21, 23, 27, 29, 30, 36, 37, 38, 39, 42, 51, 52, 56, 64)
# Denied: PR_SET_DUMPABLE (init must be able to measure), _SECCOMP (nobody counts the memory of
# filters), _MM, _SYSCALL_USER_DISPATCH, and capabilities. An option in neither list fails with
# EINVAL, like an unknown option.
_PR_DENIED = (4, 8, 22, 24, 28, 35, 47, 59)
# arch_prctl: segment bases, which new threads need, and matrix registers (AMX), which torch uses.
_ARCH_PRCTLS = (0x1001, 0x1002, 0x1003, 0x1004, 0x1021, 0x1022, 0x1023)
BROKERED = ("kill", "tkill", "tgkill", "setpgid")
"""Calls that could reach init, where nothing else keeps the jail's signals inside."""


def policy_table(
    *,
    namespaced: bool,
    network: str,
    brokered: bool = False,
    measured: bool = False,
    scoped: bool = True,
) -> dict[str, Verdict]:
    """Returns the verdict of each system call; missing calls are denied.

    Args:
        namespaced: A mount, pid and IPC namespace hold the jail, so that paths, processes and
            IPC objects of the host are out of reach anyway.
        brokered: Init decides on ``BROKERED``: see ``notify``.
        measured: No control group counts the jail's memory: see ``watchdog``.
        scoped: Landlock keeps the abstract sockets of the network namespace out of reach.
    """
    verdicts: dict[str, Verdict] = {}
    for group in (_MEMORY, _FILES, _PROCESSES, _SIGNALS, _CONNECTED_SOCKETS):
        verdicts |= dict.fromkeys(group.split(), ALLOW)
    verdicts |= dict.fromkeys(_WITHOUT_EFFECT.split(), PRETEND)
    verdicts |= dict.fromkeys(_ABSENT.split(), ENOSYS)
    verdicts |= _filtered()
    if measured:
        verdicts |= _unmeasurable()
    own = namespaced and network != "host"
    verdicts |= _sockets(own or (namespaced and scoped), network, own=own)
    verdicts |= dict.fromkeys(_NAMESPACED.split(), ALLOW) if namespaced else _without_namespaces()
    verdicts |= dict.fromkeys(WITHOUT_ATTRIBUTES, _ENOTSUP)
    if brokered:
        verdicts |= dict.fromkeys(BROKERED, ASK)
        verdicts["pidfd_send_signal"] = ENOSYS
    return verdicts


def recorded_calls(verdicts: Mapping[str, Verdict], names: Iterable[str]) -> dict[str, Verdict]:
    """Returns a table in which init answers denied calls, so that it can record them.

    Calls that fail with ENOSYS, or that do nothing, are not recorded: libraries merely probe for
    them. Calls that name files or processes, which may belong to others, pass through init on their
    way to the kernel.
    ``names``: all system calls.
    """
    denied = {name: _asking(name, verdicts.get(name, EPERM)) for name in names}
    seen: dict[str, Verdict] = dict.fromkeys(watched_calls(verdicts), ASK)
    if "sendto" in seen:  # a connected socket names no other
        seen["sendto"] = ByArguments((((Check(4, 0, wide=True),), ALLOW),), ASK)
    return denied | {name: verdict for name, verdict in seen.items() if name in denied}


def watched_calls(verdicts: Mapping[str, Verdict]) -> frozenset[str]:
    """Returns permitted calls that name files or processes.

    Init lets the kernel continue them, except ``WITHOUT_ATTRIBUTES``. Calls that the filter decides
    by arguments are left out: the kernel would continue them without that check.
    """
    seen = (ALLOW, _ENOTSUP)
    return frozenset(name for name in (*NAMED, *NAMING) if verdicts.get(name) in seen)


def _asking(name: str, verdict: Verdict) -> Verdict:
    reported = {EPERM, _EAFNOSUPPORT} | ({PRETEND} if name in PRETENDED else set())
    if not isinstance(verdict, ByArguments):
        return ASK if verdict in reported else verdict
    rules = ((checks, ASK if action in reported else action) for checks, action in verdict.rules)
    return ByArguments(tuple(rules), ASK if verdict.otherwise in reported else verdict.otherwise)


def refusal(call: str) -> int:
    """Returns the errno of a denied call; 0 if it seems to succeed."""
    if call in PRETENDED:
        return 0
    if call in WITHOUT_ATTRIBUTES:
        return errno.ENOTSUP
    return errno.EAFNOSUPPORT if call in ("socket", "socketpair") else errno.EPERM


def _filtered() -> dict[str, Verdict]:
    """Returns the calls that are decided by their arguments under every profile."""
    own = ((Check(0, 0), Check(1, 0)), ALLOW)
    return {
        "clone": ByArguments((((Check(0, 0, _NAMESPACES),), ALLOW),), EPERM),
        # clone3 has its flags in memory, which a filter cannot read; the C library falls back.
        "clone3": ENOSYS,
        "prctl": _by_option(0, _PRCTLS, _PR_DENIED),
        "arch_prctl": _by_option(0, _ARCH_PRCTLS),
        "prlimit64": ByArguments((((Check(0, 0),), ALLOW),), EPERM),
        "setpriority": ByArguments((own,), EPERM),
        "ioprio_set": EPERM,
        # Fifos only: libraries make no other file by mknod.
        "mknod": ByArguments((((Check(1, _S_IFIFO, _S_IFMT),), ALLOW),), EPERM),
        "mknodat": ByArguments((((Check(2, _S_IFIFO, _S_IFMT),), ALLOW),), EPERM),
        "ioctl": _ioctls(),
        "fcntl": _fcntls(),
        "setsockopt": _socket_options(),
        "mmap": ByArguments(_HUGE, ALLOW),
    }


def _fcntls() -> ByArguments:
    """Deny operations that affect other processes through a file that is open for reading.

    A lease on a file, or a delegation of a folder, blocks other processes that open it.
    Notifications tell what others do in a folder. Owner operations make the kernel send signals.
    Pipe pages are counted per user: a few large pipes would leave tiny ones to the user's other
    programs.
    """
    owners = (_F_SETOWN, _F_SETSIG, _F_SETOWN_EX)
    others = (_F_SETPIPE_SZ, _F_SET_RW_HINT, _F_SET_FILE_RW_HINT)
    denied = (*owners, _F_SETLEASE, _F_NOTIFY, _F_SETDELEG, *others)
    return _by_option(1, _FCNTLS, denied)


def _by_option(arg: int, allowed: Iterable[int], denied: Iterable[int] = ()) -> ByArguments:
    """Decides by the option in argument ``arg``; an option in neither list fails with EINVAL."""
    rules = [((Check(arg, option),), ALLOW) for option in allowed]
    return ByArguments((*rules, *(((Check(arg, option),), EPERM) for option in denied)), EINVAL)


def _socket_options() -> ByArguments:
    """Ignores new buffer sizes, since init counts the default, and denies filters, since they take
    kernel memory.
    """

    def rules(verdict: int, *options: int) -> Rules:
        return tuple(((Check(1, _SOL_SOCKET), Check(2, option)), verdict) for option in options)

    sizes = rules(PRETEND, _SO_SNDBUF, _SO_RCVBUF, _SO_SNDBUFFORCE, _SO_RCVBUFFORCE)
    filters = (_SO_ATTACH_FILTER, _SO_ATTACH_BPF, _SO_ATTACH_CBPF, _SO_ATTACH_EBPF)
    return ByArguments(sizes + rules(EPERM, *filters), ALLOW)


def _unmeasurable() -> dict[str, Verdict]:
    """Denies memory that init cannot see because no process has it open or mapped.

    A memfd can wait in a socket, and shared memory keeps all pages while one of them is mapped.
    Programs fall back to files in the scratch, whose size is bounded.
    """
    anonymous = Check(3, _MAP_SHARED | _MAP_ANONYMOUS, _MAP_SHARED | _MAP_ANONYMOUS)
    small = Check(1, 0, 0xFFFFFFFF & ~(SHARED_BYTES - 1), wide=True)
    rules = (*_HUGE, ((anonymous, small), ALLOW), ((anonymous,), EPERM))
    return {"memfd_create": ENOSYS, "mmap": ByArguments(rules, ALLOW)}


def _ioctls() -> ByArguments:
    # File systems' own ioctls, which Landlock does not check: 'f', 'v' and 'X' change flags,
    # versions, encryption and verity of a file that is open for reading, 0x94 (btrfs) and 0xf5
    # (f2fs) also volumes.
    kinds = (ord("f"), ord("v"), ord("X"), 0x94, 0xF5)
    families = tuple(((Check(1, kind << 8, 0xFF00),), _ENOTTY) for kind in kinds)
    denied = (_TIOCSTI, _TIOCLINUX, _TIOCCONS, _TIOCSETD, _FIOSETOWN, _SIOCSPGRP)
    rules = families + tuple(((Check(1, request),), EPERM) for request in denied)
    return ByArguments(rules, ALLOW)


def _sockets(local: bool, network: str, *, own: bool) -> dict[str, Verdict]:
    """Returns the verdicts for socket calls.

    ``local``: sockets may have names in the file system, where only the jail's processes have any.
    ``own``: the jail has a network namespace, which its user namespace owns.
    """
    internet = network != "none"
    verdicts: dict[str, Verdict] = {
        "socket": ByArguments(_families(local, internet, own), _EAFNOSUPPORT),
        "socketpair": ByArguments(_pairs(local), _EAFNOSUPPORT),
        "sendto": ByArguments((((Check(4, 0, wide=True),), ALLOW),), EPERM),
    }
    if local or internet:
        verdicts |= dict.fromkeys([*_OTHER_SOCKETS.split(), "sendto"], ALLOW)
    return verdicts


def _families(local: bool, internet: bool, own: bool) -> Rules:
    rules: list[tuple[tuple[Check, ...], int]] = []
    if own:
        # Netlink: programs list network devices, and SDL's games exit if they cannot wait for new
        # input devices. The jail has only lo, cannot change it without a capability, and the kernel
        # sends device events to the first user namespace only.
        for kind in (_SOCK_DGRAM, _SOCK_RAW):
            for protocol in (_NETLINK_ROUTE, _NETLINK_KOBJECT_UEVENT):
                checks = (Check(0, _AF_NETLINK), Check(1, kind, _SOCK_TYPE), Check(2, protocol))
                rules.append((checks, ALLOW))
    if local:
        rules.append(((Check(0, _AF_UNIX),), ALLOW))
    if internet:
        for family in (_AF_INET, _AF_INET6):
            # Protocols 0, TCP and UDP: MPTCP and raw sockets have their own numbers.
            for kind, protocol in ((_SOCK_STREAM, 6), (_SOCK_DGRAM, 17)):
                for allowed in (0, protocol):
                    checks = (Check(0, family), Check(1, kind, _SOCK_TYPE), Check(2, allowed))
                    rules.append((checks, ALLOW))
    return tuple(rules)


def _pairs(local: bool) -> Rules:
    # Without a mount namespace a datagram pair would send to any socket file of the host.
    kinds = [_SOCK_STREAM, _SOCK_SEQPACKET, *([_SOCK_DGRAM] if local else [])]
    return tuple(((Check(0, _AF_UNIX), Check(1, kind, _SOCK_TYPE)), ALLOW) for kind in kinds)


def _without_namespaces() -> dict[str, Verdict]:
    # A program that touches a path takes a success to mean that the file exists, and does not
    # create it. So only calls on a descriptor (no path) pretend to succeed.
    touched = ((Check(1, 0, wide=True),), PRETEND), ((Check(2, 0, wide=True),), EPERM)
    return {
        **dict.fromkeys(_MODES_AND_TIMES.split(), PRETEND),
        "utimensat": ByArguments(touched, PRETEND),
        "sched_setaffinity": ByArguments((((Check(0, 0),), ALLOW),), PRETEND),
    }

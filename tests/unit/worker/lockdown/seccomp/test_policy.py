"""The system call filter, run in an interpreter over (architecture, number, arguments)."""

import errno
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.seccomp import filter
from envhub_worker.lockdown.seccomp.bpf import BpfInstruction
from envhub_worker.lockdown.seccomp.policy import (
    ALLOW,
    ASK,
    EINVAL,
    ENOSYS,
    EPERM,
    KILL_PROCESS,
    PRETEND,
    SHARED_BYTES,
    WITHOUT_ATTRIBUTES,
    ByArguments,
    policy_table,
    recorded_calls,
    refusal,
    watched_calls,
)
from envhub_worker.lockdown.seccomp.syscalls import NUMBERS
from tests.unit.worker.lockdown.seccomp.bpf_machine import listing, run

GOLDEN = Path(__file__).parents[3] / "golden"
ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
I386 = 0x40000003
NOT_SUPPORTED = 0x00050000 | errno.EAFNOSUPPORT
NO_ATTRIBUTES = 0x00050000 | errno.ENOTSUP
NO_MEMORY = 0x00050000 | errno.ENOMEM
NOT_A_TTY = 0x00050000 | errno.ENOTTY
VARIANTS = [(True, "none"), (True, "loopback"), (True, "host"), (False, "none"), (False, "host")]
machines = pytest.mark.parametrize("machine", ["x86_64", "aarch64"])


class Filter:
    """A compiled filter that answers by name."""

    def __init__(self, machine: str, namespaced: bool, network: str = "none", **more: bool) -> None:
        self.machine = machine
        self.program: Sequence[BpfInstruction] = filter.program(
            machine, policy_table(namespaced=namespaced, network=network, **more)
        )

    def __call__(self, name: str, *args: int) -> int:
        return run(self.program, ARCH[self.machine], NUMBERS[self.machine][name], args)


@machines
@pytest.mark.parametrize(("namespaced", "network"), VARIANTS)
def test_program_is_the_golden_one(machine: str, namespaced: bool, network: str) -> None:
    name = f"seccomp-{machine}-{'namespaced' if namespaced else 'bare'}-{network}.txt"
    verdicts = policy_table(namespaced=namespaced, network=network)
    program = filter.program(machine, verdicts)
    assert listing(program) == (GOLDEN / name).read_text()
    names = {number: name for name, number in NUMBERS[machine].items()}
    for number in range(600):
        verdict = verdicts.get(names.get(number, ""), EPERM if number in names else ENOSYS)
        if not isinstance(verdict, ByArguments):
            assert run(program, ARCH[machine], number) == verdict, names.get(number, number)


@machines
def test_other_architectures_are_killed(machine: str) -> None:
    check = Filter(machine, True)
    for arch in {I386, *ARCH.values()} - {ARCH[machine]}:
        assert run(check.program, arch, NUMBERS[machine]["read"]) == KILL_PROCESS


def test_x32_numbers_are_killed() -> None:
    check = Filter("x86_64", True)
    for number in (0x40000000, 0x40000000 | NUMBERS["x86_64"]["ptrace"], 0xFFFFFFFF):
        assert run(check.program, ARCH["x86_64"], number) == KILL_PROCESS


DENIED = """
    ptrace process_vm_readv process_vm_writev kcmp pidfd_getfd process_madvise perf_event_open bpf
    userfaultfd io_uring_setup io_uring_enter io_uring_register keyctl add_key request_key mount
    umount2 pivot_root chroot open_tree move_mount fsopen fsconfig fsmount fspick mount_setattr
    open_tree_attr unshare setns swapon swapoff reboot kexec_load kexec_file_load init_module
    finit_module delete_module acct quotactl quotactl_fd open_by_handle_at name_to_handle_at
    settimeofday clock_settime clock_adjtime adjtimex syslog vhangup sethostname setdomainname
    fanotify_init fanotify_mark move_pages migrate_pages remap_file_pages memfd_secret seccomp
    landlock_restrict_self vmsplice lookup_dcookie io_setup io_submit process_mrelease
    statmount listmount capset setgroups setfsuid setfsgid personality rt_sigqueueinfo
    rt_tgsigqueueinfo get_robust_list mlockall munlockall mbind set_mempolicy
"""
# What programs fall back from, and what they go on after, each by a name of its own kind.
ABSENT = """
    inotify_init1 inotify_add_watch semget semtimedop msgget mq_open shmget shmat shmctl shmdt
    openat2 execveat splice tee signalfd4 epoll_pwait2 mlock2 mseal pkey_alloc pkey_free
    pkey_mprotect futex_waitv futex_wake futex_wait futex_requeue
"""
WITHOUT_EFFECT = """
    setuid setgid setreuid setregid setresuid setresgid sched_setscheduler sched_setattr sync syncfs
    sync_file_range readahead
"""


@machines
@pytest.mark.parametrize("namespaced", [True, False])
@pytest.mark.parametrize(
    ("names", "verdict"),
    [(DENIED, EPERM), (ABSENT, ENOSYS), (WITHOUT_EFFECT, PRETEND)],
    ids=["denied", "absent", "without"],
)
def test_nothing_needless_passes(machine: str, namespaced: bool, names: str, verdict: int) -> None:
    check = Filter(machine, namespaced, "host")
    for name in names.split():
        for arguments in ((), (0,), (1, 2, 3, 4, 5, 6)):
            assert check(name, *arguments) == verdict, name


Row = tuple[dict[str, Any], int, list[tuple[Any, ...]]]
THREADS = 0x003D0F00
NAMESPACES = (0x20000, 0x2000000, 0x4000000, 0x8000000, 0x10000000, 0x20000000, 0x40000000)
TCP_AND_UDP = ((1, 0), (1, 6), (2, 0), (2, 17), (1 | 0o2000000, 0))
OTHERS = ((1, 262), (3, 0), (3, 1), (2, 1), (5, 0), (1, 132))  # MPTCP, raw, SCTP
PATH, TIMES = 0x7F00_0000_0010, 0x7F00_0000_0020
MODES = ("fchmod", "fchmodat", "fchmodat2", "fchown", "fchownat", "utimensat")
REMOVING = ("removexattr", "lremovexattr")
TO_AN_ADDRESS = [("sendto", 3, 0, 0, 0, 0x1000), ("sendto", 3, 0, 0, 0, 1 << 32)]


def under(verdict: int, calls: list[tuple[Any, ...]], *namespaced: bool, **options: Any) -> Row:
    """Calls that get this verdict; with namespaces and without, where nothing is said."""
    return {"namespaced": namespaced or (True, False), **options}, verdict, calls


def of(name: str, *first: int, last: Sequence[int]) -> list[tuple[Any, ...]]:
    """Calls that differ in their last argument; the kernel reads 32 bits of some."""
    return [(name, *first, one) for one in last]


NETLINKS = [("socket", 16, kind, protocol) for kind in (2, 3) for protocol in (0, 15)]
CLAIMS: dict[str, list[Row]] = {
    "clone3's flags lie in memory, those of clone are checked one by one": [
        under(ENOSYS, [("clone3",)], True),
        under(ALLOW, of("clone", last=(THREADS, 17)), True),  # SIGCHLD: a plain fork
        under(EPERM, of("clone", last=[THREADS | flag for flag in NAMESPACES]), True),
    ],
    "without network local sockets where no file of the host is in reach, and nothing else": [
        under(ALLOW, [("socket", 1, 1), ("socketpair", 1, 2)], True),
        under(NOT_SUPPORTED, [("socket", 1, 1), ("socketpair", 1, 2)], False),
        under(NOT_SUPPORTED, [("socket", one, 1) for one in (2, 10, 16, 17, 40, 44, 1 << 32 | 2)]),
        under(NOT_SUPPORTED, [("socketpair", 2, 1)]),
        under(ALLOW, of("socketpair", 1, last=(1, 1 | 0o2000000 | 0o4000))),  # CLOEXEC, NONBLOCK
    ],
    "netlink tells a jail of its own devices, where it has a network of its own, and no more": [
        under(ALLOW, NETLINKS, True),
        under(ALLOW, NETLINKS, True, network="loopback"),
        under(NOT_SUPPORTED, NETLINKS, True, network="host"),
        under(NOT_SUPPORTED, NETLINKS, False),
        under(NOT_SUPPORTED, [("socket", 16, 3, one) for one in (2, 4, 9, 11, 12, 16)]),
        under(NOT_SUPPORTED, [("socket", 16, 1, 0), ("socketpair", 16, 3, 0)]),
    ],
    "local sockets end where the host's abstract names begin and Landlock does not": [
        under(NOT_SUPPORTED, of("socket", 1, last=(1, 2)), True, network="host", scoped=False),
        under(NOT_SUPPORTED, [("socketpair", 1, 2)], True, network="host", scoped=False),
        under(ALLOW, [("socketpair", 1, 1), ("socket", 2, 1)], True, network="host", scoped=False),
        under(ALLOW, [("socket", 1, 1)], True, network="host"),
    ],
    "internet sockets are TCP and UDP only, even on the host's network": [
        under(ALLOW, [("socket", f, *one) for f in (2, 10) for one in TCP_AND_UDP], network="host"),
        under(
            NOT_SUPPORTED,
            [("socket", 16, 3), *(("socket", f, *one) for f in (2, 10) for one in OTHERS)],
            network="host",
        ),
    ],
    "sending to an address is denied without namespaces, and both halves of a pointer count": [
        under(ALLOW, [("sendto", 3, 0, 0, 0, 0)], False),
        under(EPERM, TO_AN_ADDRESS, False),
        under(EPERM, [(name,) for name in ("bind", "connect", "listen", "accept4")], False),
    ],
    "only own limits and priority change": [
        under(ALLOW, [*of("prlimit64", last=(0, 1 << 32)), ("setpriority", 0, 0)]),
        under(
            EPERM, [("prlimit64", 1), *(("setpriority", *one) for one in ((0, 1), (1, 0), (2, 0)))]
        ),
    ],
    "terminal injection (TIOCSTI) and file flags (FS_IOC_SETFLAGS) are denied, FIOCLEX is not": [
        under(EPERM, of("ioctl", 1, last=(0x5412, 0x541C, 0x541D, 0x5423, 1 << 32 | 0x5412)), True),
        under(NOT_A_TTY, of("ioctl", 1, last=(0x40086602, 0x40806685, 0x401C5820)), True),
        under(NOT_A_TTY, of("ioctl", 1, last=(0xC0045877, 0x40087602, 0x5000940E)), True),
        under(ALLOW, of("ioctl", 1, last=(0x5401, 0x5451, 0x5421, 0x541B)), True),
    ],
    "prctl: no filters, no hiding from the watchdog; others are invalid": [
        under(EPERM, [("prctl", one, 0) for one in (4, 8, 22, 24, 28, 35, 47, 59)], True),
        under(EPERM, [("prctl", 1 << 32 | 22)], True),
        under(ALLOW, of("prctl", last=(1, 15, 16, 21, 23, 36, 38, 39)), True),
        under(EINVAL, of("prctl", last=(41, 53, 62, 67, 78)), True),
        under(EINVAL, of("prctl", last=(0x53564D41, 0x59616D61, 1 << 31)), True),
    ],
    "modes and times are pretended without a mount namespace, where Landlock cannot stop them": [
        under(PRETEND, [(name,) for name in MODES], False),
        under(ALLOW, [(name,) for name in (*MODES, *REMOVING)], True),
        under(EPERM, [(name,) for name in REMOVING], False),
        under(ALLOW, [("sched_setaffinity", 0)], False),
        under(PRETEND, [("sched_setaffinity", 1)], False),
        under(PRETEND, [("utimensat", 3, PATH, TIMES, 0), ("utimensat", 3, 0, 0, 0)], False),
        under(EPERM, [("utimensat", 3, PATH, 0, 0)], False),  # a touch says that the file is there
    ],
    "what reaches others through a readable file is denied: leases, notices, owners, pipes": [
        under(EPERM, of("fcntl", 0, last=(8, 10, 15, 1024, 1026, 1031, 1036, 1038, 1040))),
        under(EPERM, [("fcntl", 0, 1 << 32 | 1024), *of("ioctl", 0, last=(0x8901, 0x8902))]),
        under(ALLOW, of("fcntl", 0, last=(0, 1, 2, 3, 4, 6, 7, 36, 1030, 1032, 1034))),
        under(EINVAL, of("fcntl", 0, last=(12, 35, 1039, 1041, 1 << 31))),
    ],
    "buffers of sockets keep their size, which init counts; TCP's own options are free": [
        under(PRETEND, of("setsockopt", 3, 1, last=(7, 8, 32, 33)), True, network="host"),
        under(ALLOW, of("setsockopt", 3, 6, last=(7, 8, 32, 33)), True, network="host"),
        under(EPERM, of("setsockopt", 3, 1, last=(26, 50, 51, 52)), True, network="host"),
        under(ALLOW, [("setsockopt", 3, 1, 2)], True, network="host"),  # SO_REUSEADDR
    ],
    "signals are handed to init where it sends them; what has no broker is denied or falls back": [
        under(ASK, [(one, 1, 15) for one in ("kill", "tkill", "tgkill")], False, brokered=True),
        under(ASK, [("setpgid", 0, 1)], False, brokered=True),
        under(EPERM, [("rt_sigqueueinfo", 1, 15)], False, brokered=True),
        under(ENOSYS, [("pidfd_send_signal", 1, 15)], False, brokered=True),
    ],
    "attributes of files, which take memory that nothing counts, are not to be had": [
        under(NO_ATTRIBUTES, [(name,) for name in ("setxattr", "lsetxattr", "fsetxattr")]),
        under(EPERM, [("setxattrat",)]),
    ],
    "only fifos are made": [
        under(ALLOW, [("mknodat", 0, 0, 0o10644)], True),
        under(EPERM, of("mknodat", 0, 0, last=(0o100644, 0o644, 0o20644)), True),
    ],
}


@machines
@pytest.mark.parametrize("claim", CLAIMS)
def test_calls_are_judged_by_their_arguments(machine: str, claim: str) -> None:
    for options, verdict, calls in CLAIMS[claim]:
        for namespaced in options["namespaced"]:
            check = Filter(machine, **{**options, "namespaced": namespaced})
            for name, *arguments in calls:
                assert check(name, *arguments) == verdict, (namespaced, name, arguments)


def test_arch_prctl_has_a_list_of_options() -> None:
    """Segment bases, and the registers that torch asks for; neither faults nor maps."""
    check = Filter("x86_64", True)
    for option in (0x1002, 0x1003, 0x1022, 0x1023):
        assert check("arch_prctl", option) == ALLOW
    for option in (0x1012, 0x2001, 0x2003, 0x3001, 0x4001, 0x5001):
        assert check("arch_prctl", option) == EINVAL


@machines
def test_memory_out_of_sight_is_denied_where_it_is_measured(machine: str) -> None:
    """Files without a name, and shared memory but for a little; mapped files are what they were."""
    counted, measured = Filter(machine, True), Filter(machine, True, measured=True)
    shared, private, anonymous, validate, huge = 1, 2, 0x20, 3, 0x40000
    assert measured("memfd_create") == ENOSYS
    assert counted("memfd_create") == ALLOW
    for size, verdict in (
        (SHARED_BYTES - 1, ALLOW),
        (SHARED_BYTES, EPERM),
        (1 << 32, EPERM),
        (1 << 40 | 4096, EPERM),
    ):
        for kind in (shared, validate):
            assert measured("mmap", 0, size, 3, kind | anonymous) == verdict
        assert counted("mmap", 0, size, 3, shared | anonymous) == ALLOW
        assert measured("mmap", 0, size, 3, private | anonymous) == ALLOW
        assert measured("mmap", 0, size, 3, shared, 5) == ALLOW
    for filtered in (measured, counted):
        assert filtered("mmap", 0, 1 << 21, 3, private | anonymous | huge) == NO_MEMORY


@machines
@pytest.mark.parametrize("network", ["none", "host"])
@pytest.mark.parametrize("namespaced", [True, False])
def test_what_is_recorded_is_denied_too(machine: str, network: str, namespaced: bool) -> None:
    """Whatever is asked of init is what would have been refused, and init refuses it likewise. With
    one exception: what would have been permitted whatever its arguments, and is only seen."""
    plain = policy_table(namespaced=namespaced, network=network)
    asking, seen = recorded_calls(plain, NUMBERS[machine]), watched_calls(plain)
    assert seen == watched_calls(
        policy_table(namespaced=namespaced, network=network, measured=True)
    )
    first, second = filter.program(machine, plain), filter.program(machine, asking)
    refused = set()
    for name, call in NUMBERS[machine].items():
        for arguments in ((), (2,), (0x10000000, 3), (1, 8, 1), (2, 0, 0, 0, 1)):
            was = run(first, ARCH[machine], call, arguments)
            now = run(second, ARCH[machine], call, arguments)
            if name == "sendto" in seen:
                assert (was, now) == (ALLOW, ASK if any(arguments[4:5]) else ALLOW)
            elif name in WITHOUT_ATTRIBUTES and name in seen:
                assert (was, now, refusal(name)) == (NO_ATTRIBUTES, ASK, errno.ENOTSUP)
            elif name in seen:
                assert (was, now) == (ALLOW, ASK)
            elif now == ASK:
                assert was & 0xFFFF == refusal(name)
                refused.add(name)
            else:
                assert now == was
    assert refused >= {"ptrace", "mount", "bpf", "unshare", "clone", "socket"}
    assert "kill" not in refused
    assert "sched_setscheduler" in refused, "it only seems to work, and does so still"
    assert seen >= {"openat", "unlinkat", "renameat2", "kill", "pidfd_open"}
    assert ("fchmodat" in seen, "connect" in seen) == (namespaced, namespaced or network == "host")


def test_unknown_machine_is_refused() -> None:
    with pytest.raises(LayerUnavailableError, match="riscv64"):
        filter.program("riscv64", {})

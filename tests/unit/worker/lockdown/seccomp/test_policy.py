"""The system call filter, run in an interpreter over (architecture, number, arguments)."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path

import pytest

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.seccomp import bpf, filter
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
    ByArguments,
    policy_table,
    recorded_calls,
    refusal,
    watched_calls,
)
from envhub_worker.lockdown.seccomp.syscalls import NUMBERS
from tests.unit.worker.lockdown.seccomp.bpf_machine import run

GOLDEN = Path(__file__).parents[3] / "golden"
ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
I386 = 0x40000003
NOT_SUPPORTED = 0x00050000 | errno.EAFNOSUPPORT
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
        """The verdict for the call ``name`` with ``args``."""
        return run(self.program, ARCH[self.machine], NUMBERS[self.machine][name], args)


@machines
@pytest.mark.parametrize(("namespaced", "network"), VARIANTS)
def test_program_is_the_golden_one(machine: str, namespaced: bool, network: str) -> None:
    """Any change of the compiled program shows in a review."""
    name = f"seccomp-{machine}-{'namespaced' if namespaced else 'bare'}-{network}.txt"
    program = filter.program(machine, policy_table(namespaced=namespaced, network=network))
    assert bpf.listing(program) == (GOLDEN / name).read_text()


@machines
def test_times_are_pretended_but_for_a_touch(machine: str) -> None:
    """A touch that succeeds means that the file is there, and this one may not be."""
    filtered = Filter(machine, namespaced=False)
    path, times = 0x7F00_0000_0010, 0x7F00_0000_0020
    assert filtered("utimensat", 3, path, times, 0) == PRETEND
    assert filtered("utimensat", 3, 0, 0, 0) == PRETEND
    assert filtered("utimensat", 3, path, 0, 0) == EPERM


@machines
@pytest.mark.parametrize(("namespaced", "network"), VARIANTS)
def test_every_number_gets_the_verdict_of_the_table(
    machine: str, namespaced: bool, network: str
) -> None:
    """The search tree agrees with the table for every number to well above the highest."""
    verdicts = policy_table(namespaced=namespaced, network=network)
    program = filter.program(machine, verdicts)
    names = {number: name for name, number in NUMBERS[machine].items()}
    for number in range(600):
        verdict = verdicts.get(names.get(number, ""), EPERM if number in names else ENOSYS)
        if not isinstance(verdict, ByArguments):
            assert run(program, ARCH[machine], number) == verdict, names.get(number, number)


@machines
def test_other_architectures_are_killed(machine: str) -> None:
    """int 0x80 and the other machine's numbers mean other calls."""
    check = Filter(machine, True)
    for arch in {I386, *ARCH.values()} - {ARCH[machine]}:
        assert run(check.program, arch, NUMBERS[machine]["read"]) == KILL_PROCESS


def test_x32_numbers_are_killed() -> None:
    """They reach the same calls under numbers that no table lists."""
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
@pytest.mark.parametrize("name", DENIED.split())
def test_dangerous_call_is_denied(machine: str, namespaced: bool, name: str) -> None:
    """Under every profile and network."""
    assert Filter(machine, namespaced, "host")(name) == EPERM


@machines
@pytest.mark.parametrize("namespaced", [True, False])
@pytest.mark.parametrize(
    ("names", "verdict"), [(ABSENT, ENOSYS), (WITHOUT_EFFECT, PRETEND)], ids=["absent", "without"]
)
def test_what_no_library_needs_never_reaches_the_kernel(
    machine: str, namespaced: bool, names: str, verdict: int
) -> None:
    """Under every profile and network, whatever the arguments."""
    check = Filter(machine, namespaced, "host")
    for name in names.split():
        for arguments in ((), (0,), (1, 2, 3, 4, 5, 6)):
            assert check(name, *arguments) == verdict, name


@machines
def test_clone3_falls_back_and_clone_makes_no_namespace(machine: str) -> None:
    """The flags of clone3 lie in memory; those of clone are checked one by one."""
    check = Filter(machine, True)
    assert check("clone3") == ENOSYS
    threads = 0x003D0F00
    assert check("clone", threads) == ALLOW
    assert check("clone", 17) == ALLOW  # SIGCHLD: a plain fork
    for flag in (0x20000, 0x2000000, 0x4000000, 0x8000000, 0x10000000, 0x20000000, 0x40000000):
        assert check("clone", threads | flag) == EPERM


@machines
@pytest.mark.parametrize("namespaced", [True, False])
def test_socket_families_without_network(machine: str, namespaced: bool) -> None:
    """Local sockets where no file of the host is in reach; nothing else, whatever the high bits."""
    check = Filter(machine, namespaced)
    assert check("socket", 1, 1) == (ALLOW if namespaced else NOT_SUPPORTED)
    for family in (2, 10, 16, 17, 40, 44, 1 << 32 | 2):
        assert check("socket", family, 1) == NOT_SUPPORTED
    assert check("socketpair", 1, 1) == ALLOW
    assert check("socketpair", 1, 1 | 0o2000000 | 0o4000) == ALLOW  # CLOEXEC, NONBLOCK
    assert check("socketpair", 1, 2) == (ALLOW if namespaced else NOT_SUPPORTED)
    assert check("socketpair", 2, 1) == NOT_SUPPORTED


@machines
def test_local_sockets_end_where_the_hosts_abstract_names_begin(machine: str) -> None:
    """On the host's network, with a Landlock that does not keep them out of reach."""
    verdict = Filter(machine, True, "host", scoped=False)
    assert verdict("socket", 1, 1) == verdict("socket", 1, 2) == NOT_SUPPORTED
    assert verdict("socketpair", 1, 2) == NOT_SUPPORTED
    assert verdict("socketpair", 1, 1) == verdict("socket", 2, 1) == ALLOW
    assert Filter(machine, True, "host")("socket", 1, 1) == ALLOW


@machines
@pytest.mark.parametrize("namespaced", [True, False])
def test_internet_sockets_are_tcp_and_udp_only(machine: str, namespaced: bool) -> None:
    """No raw, no MPTCP, no SCTP, no netlink, even on the host's network."""
    check = Filter(machine, namespaced, "host")
    for family in (2, 10):
        for kind, protocol in ((1, 0), (1, 6), (2, 0), (2, 17), (1 | 0o2000000, 0)):
            assert check("socket", family, kind, protocol) == ALLOW
        for kind, protocol in ((1, 262), (3, 0), (3, 1), (2, 1), (5, 0), (1, 132)):
            assert check("socket", family, kind, protocol) == NOT_SUPPORTED
    assert check("socket", 16, 3) == NOT_SUPPORTED


@machines
def test_sending_to_an_address_is_denied_without_namespaces(machine: str) -> None:
    """Both halves of the pointer count."""
    check = Filter(machine, False)
    assert check("sendto", 3, 0, 0, 0, 0) == ALLOW
    assert check("sendto", 3, 0, 0, 0, 0x1000) == EPERM
    assert check("sendto", 3, 0, 0, 0, 1 << 32) == EPERM
    for name in ("bind", "connect", "listen", "accept4"):
        assert check(name) == EPERM


@machines
@pytest.mark.parametrize("namespaced", [True, False])
def test_only_own_limits_and_priority_change(machine: str, namespaced: bool) -> None:
    """prlimit and setpriority of another process are denied."""
    check = Filter(machine, namespaced)
    assert check("prlimit64", 0) == ALLOW
    assert check("prlimit64", 1) == EPERM
    assert check("prlimit64", 1 << 32) == ALLOW  # the kernel reads 32 bits: that is 0
    assert check("setpriority", 0, 0) == ALLOW
    for which, who in ((0, 1), (1, 0), (2, 0)):
        assert check("setpriority", which, who) == EPERM


@machines
def test_terminal_injection_and_file_flags_are_denied(machine: str) -> None:
    """TIOCSTI and friends; FS_IOC_SETFLAGS and all of its kind; FIOCLEX and TCGETS go through."""
    check = Filter(machine, True)
    for request in (0x5412, 0x541C, 0x541D, 0x5423, 1 << 32 | 0x5412):
        assert check("ioctl", 1, request) == EPERM
    for request in (0x40086602, 0x40806685, 0x401C5820, 0xC0045877, 0x40087602, 0x5000940E):
        assert check("ioctl", 1, request) == NOT_A_TTY
    for request in (0x5401, 0x5451, 0x5421, 0x541B):
        assert check("ioctl", 1, request) == ALLOW


@machines
def test_prctl_has_a_list_of_options(machine: str) -> None:
    """No filters, whose memory nobody counts; no hiding from the watchdog; others are invalid."""
    check = Filter(machine, True)
    for option in (4, 8, 22, 24, 28, 35, 47, 59):
        assert check("prctl", option, 0) == EPERM
    for option in (1, 15, 16, 21, 23, 36, 38, 39):
        assert check("prctl", option) == ALLOW
    for option in (41, 53, 62, 67, 78, 0x53564D41, 0x59616D61, 1 << 31):
        assert check("prctl", option) == EINVAL
    assert check("prctl", 1 << 32 | 22) == EPERM  # the kernel reads 32 bits


def test_arch_prctl_has_a_list_of_options() -> None:
    """Segment bases, and the registers that torch asks for; neither faults nor maps."""
    check = Filter("x86_64", True)
    for option in (0x1002, 0x1003, 0x1022, 0x1023):
        assert check("arch_prctl", option) == ALLOW
    for option in (0x1012, 0x2001, 0x2003, 0x3001, 0x4001, 0x5001):
        assert check("arch_prctl", option) == EINVAL


@machines
def test_modes_and_times_are_pretended_without_a_mount_namespace(machine: str) -> None:
    """Landlock cannot stop them there; programs that copy files go on."""
    bare, namespaced = Filter(machine, False), Filter(machine, True)
    for name in ("fchmod", "fchmodat", "fchmodat2", "fchown", "fchownat", "utimensat"):
        assert bare(name) == PRETEND
        assert namespaced(name) == ALLOW
    for name in ("setxattr", "fsetxattr", "lremovexattr"):
        assert bare(name) == EPERM
        assert namespaced(name) == ALLOW
    assert bare("sched_setaffinity", 0) == ALLOW
    assert bare("sched_setaffinity", 1) == PRETEND


@machines
@pytest.mark.parametrize("namespaced", [True, False])
def test_what_reaches_others_through_a_readable_file_is_denied(
    machine: str, namespaced: bool
) -> None:
    """Leases, notices, owners, sizes of pipes; commands that nobody knows are invalid."""
    check = Filter(machine, namespaced)
    for command in (8, 10, 15, 1024, 1026, 1031, 1036, 1038, 1040, 1 << 32 | 1024):
        assert check("fcntl", 0, command) == EPERM
    for command in (0, 1, 2, 3, 4, 6, 7, 36, 1030, 1032, 1034):
        assert check("fcntl", 0, command) == ALLOW
    for command in (12, 35, 1039, 1041, 1 << 31):
        assert check("fcntl", 0, command) == EINVAL
    for request in (0x8901, 0x8902):
        assert check("ioctl", 0, request) == EPERM


@machines
def test_buffers_of_sockets_keep_their_size(machine: str) -> None:
    """Init counts a socket with what it may hold; programs that ask for more are told yes."""
    check = Filter(machine, True, "host")
    for option in (7, 8, 32, 33):
        assert check("setsockopt", 3, 1, option) == PRETEND
        assert check("setsockopt", 3, 6, option) == ALLOW  # TCP's own options
    for option in (26, 50, 51, 52):
        assert check("setsockopt", 3, 1, option) == EPERM
    assert check("setsockopt", 3, 1, 2) == ALLOW  # SO_REUSEADDR


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
def test_signals_are_handed_to_init_where_it_sends_them(machine: str) -> None:
    """All that name a process; what has no broker is denied, or falls back."""
    check = Filter(machine, False, brokered=True)
    names = ("kill", "tkill", "tgkill", "rt_sigqueueinfo", "pidfd_send_signal")
    assert [check(name, 1, 15) for name in names] == [ASK, ASK, ASK, EPERM, ENOSYS]


@machines
@pytest.mark.parametrize("network", ["none", "host"])
@pytest.mark.parametrize("namespaced", [True, False])
def test_what_is_recorded_is_denied_all_the_same(
    machine: str, network: str, namespaced: bool
) -> None:
    """Whatever is asked of init is what would have been refused, and init refuses it likewise.

    With one exception: what would have been permitted whatever its arguments, and is only seen.
    """
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


@machines
def test_only_fifos_are_made(machine: str) -> None:
    """No device, and no file in this way."""
    check = Filter(machine, True)
    for mode, verdict in ((0o10644, ALLOW), (0o100644, EPERM), (0o644, EPERM), (0o20644, EPERM)):
        assert check("mknodat", 0, 0, mode) == verdict


def test_unknown_machine_is_refused() -> None:
    """No table, no jail."""
    with pytest.raises(LayerUnavailableError, match="riscv64"):
        filter.program("riscv64", {})

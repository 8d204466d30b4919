"""Reaching for the kernel: namespaces, mounts, rare system calls, other architectures' numbers."""

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from tests.attacks.harness import (
    ANSWER,
    USER,
    Arena,
    OpenJail,
    Run,
    control_run,
    new_alias,
    pids_named,
)
from tests.support.processes import eventually

FAMILY = "The kernel"
Look = Callable[[int, int], object]


def end(alias: str) -> None:
    assert eventually(lambda: not pids_named(alias))


def user_namespace(pid: int) -> str:
    return os.readlink(f"/proc/{pid}/ns/user")


def mounts(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/mountinfo").read_text().splitlines()


def root_options(pid: int) -> set[str]:
    """What a process may do with its root: ``{"ro", "nosuid", ...}``."""
    [line] = [line for line in mounts(pid) if line.split()[4] == "/"][-1:]
    return set(line.split()[5].split(","))


def root_of(pid: int) -> tuple[int, int]:
    status = os.stat(f"/proc/{pid}/root")
    return status.st_dev, status.st_ino


def other(fact: Callable[[int], object]) -> Look:
    return lambda child, parent: fact(child) != fact(parent)


SOURCE = f"src-{new_alias()}"
CHILDREN: dict[str, tuple[str, dict[str, str], Look]] = {
    "user namespace: unshare": ("user_namespace", {}, other(user_namespace)),
    "user namespace: clone": ("clone_with_namespace", {"way": "clone"}, other(user_namespace)),
    "user namespace: clone3": ("clone_with_namespace", {"way": "clone3"}, other(user_namespace)),
    "mount a tmpfs": (
        "mount_tmpfs",
        {"source": SOURCE},
        lambda child, parent: any(SOURCE in line for line in mounts(child)),
    ),
    "remount the root": ("remount_root", {}, other(root_options)),
    "chroot": ("chroot", {}, other(root_of)),
    "pivot_root": ("pivot_root", {}, other(root_of)),
}


@pytest.mark.short("strict-user", "strict-mount")
@pytest.mark.parametrize("title", CHILDREN)
def test_no_child_has_other_namespaces_mounts_or_roots(jail: OpenJail, title: str) -> None:
    payload, arguments, look = CHILDREN[title]
    child = new_alias()

    def got(run: Run) -> bool:
        # a child that was forked by hand takes its name a moment later
        eventually(lambda: bool(pids_named(child)), 0.5 if run.inside else 60.0)
        return any(look(pid, parent) for pid in pids_named(child) for parent in run.pids())

    jail.attack(title, payload, got, before=lambda: end(child), alias=child, **arguments)


def test_other_namespaces_cannot_be_entered(jail: OpenJail) -> None:
    child = new_alias()
    with control_run("user_namespace", {"alias": child}):
        [elsewhere] = pids_named(child)
        assert user_namespace(elsewhere) != user_namespace(os.getpid())
        joined = new_alias()
        jail.attack(
            "setns into the client's namespaces",
            "enter_namespaces",
            lambda run: any(
                user_namespace(pid) != user_namespace(parent)
                for pid in pids_named(joined)
                for parent in run.pids()
            ),
            before=lambda: end(joined),
            alias=joined,
            pid=elsewhere,
        )


OBJECTS = {
    "bpf": "bpf-map",
    "io_uring": "[io_uring]",
    "userfaultfd": "[userfaultfd]",
    "perf_event": "[perf_event]",
    "fanotify": "[fanotify]",
    "fscontext": "[fscontext]",
}


@pytest.mark.parametrize("kind", list(OBJECTS))
def test_kernel_objects_cannot_be_made(jail: OpenJail, kind: str) -> None:
    def has_it(run: Run) -> bool:
        return any(
            OBJECTS[kind] in os.readlink(f"/proc/{pid}/fd/{fd}")
            for pid in run.pids()
            for fd in os.listdir(f"/proc/{pid}/fd")
        )

    with control_run("kernel_object", {"kind": kind}) as probe:
        why = probe.error.strip().rpartition("\n")[2]
    jail.attack(f"make: {kind}", "kernel_object", has_it, kind=kind, impossible=why)


# Harmless even for root: every argument is a descriptor or a pointer that leads nowhere, or a
# number that the kernel has no meaning for.
_CALLS = """
acct 1; add_key 1 1 1 1 0; bpf 0 1 72; capset 1 1; clone3 1 64; delete_module 1 0;
epoll_pwait2 -1 1 1 0 0 0; execveat -1 1 0 0 0; fanotify_init -1 0; finit_module -1 1 0;
fsmount -1 0 0; fsopen 1 0; fspick -1 1 0; futex_waitv 1 0 0 0 0;
get_robust_list 0x7FFFFFFF 1 1; init_module 1 4096 1; io_uring_enter -1 0 0 0 0 0;
io_uring_register -1 0 0 0; io_uring_setup 1 1; ioperm 1048576 1 1; iopl 99; ioprio_set 99 0 0;
kcmp 1 1 99 0 0; kexec_file_load -1 -1 0 0 -1; kexec_load 0 1048576 1 0; keyctl 9999 0 0 0 0;
memfd_secret -1; migrate_pages 0 8 1 1; mknodat -1 1 0o100644 0; mlockall 99; modify_ldt 0 0 0;
mount 1 1 1 0 0; mount_setattr -1 1 0 1 32; move_mount -1 1 -1 1 0; move_pages 0 1 1 0 1 0;
mseal 1 1 1; name_to_handle_at -1 1 1 1 0; open_by_handle_at -1 1 0; open_tree -1 1 -1;
openat2 -1 1 1 24; perf_event_open 1 0 -1 -1 0; pidfd_getfd -1 -1 1; pivot_root 1 1;
pkey_alloc 1048576 0; pkey_free 999; prctl 22 2 1 0 0; process_madvise -1 1 1 0 -1;
process_mrelease -1 -1; process_vm_readv 1 1 0 1 0 -1; process_vm_writev 1 1 0 1 0 -1;
ptrace 16 -1 0 0; quotactl -1 1 0 1; readahead -1 0 1; reboot 0 0 0 0; request_key 1 1 1 0;
rt_sigqueueinfo 0x7FFFFFFF 0 1; seccomp 1 0 1; setdomainname 1 -1; sethostname 1 -1; setns -1 0;
settimeofday 1 0; shmctl -1 99 0; signalfd4 -1 1 8 0; splice -1 0 -1 0 1 0; swapoff 1;
swapon 1 0; sync_file_range -1 0 0 0; syslog 99 0 0; tee -1 -1 1 0; umount2 1 0; unshare 0x123;
userfaultfd -1; utime 1 0
"""
CALLS = {
    name: [int(one, 0) for one in arguments]
    for name, *arguments in map(str.split, _CALLS.split(";"))
}
UNREACHED = ("EPERM", "ENOSYS")
WITHOUT_EFFECT = ("readahead", "sync_file_range", "utime")
"""Said to have worked: the kernel, which is not asked, finds nothing there."""


def test_rare_calls_do_not_reach_the_kernel(jail: OpenJail) -> None:
    """What a program of this kind never calls is answered by the filter: EPERM, ENOSYS, or success.
    These calls leave no trace outside, so their answers have to do: outside, the kernel looks at
    the arguments and refuses those; inside, it is never asked."""
    with control_run("answers", {"calls": CALLS}) as run:
        outside = run.value
    with jail.inside("answers", {"calls": CALLS}) as run:
        inside = run.value
    assert outside, "the control never answered"
    assert inside, run.error
    failures = []
    for name, answer in outside.items():
        control, note = "succeeds", ""
        if answer in (*UNREACHED, "not on this machine"):
            control, note = "not possible", f"outside of the sandbox it answers {answer} as well"
        try:
            answers = ("0",) if name in WITHOUT_EFFECT else UNREACHED
            reached = inside[name] not in answers
            jail.judge(f"call {name}", control, reached, inside[name], note, ANSWER)
        except AssertionError as error:
            failures.append(str(error))
    assert not failures, failures


def most_filters(run: Run) -> int:
    found = [0]
    for pid in run.pids():
        with contextlib.suppress(OSError):
            status = Path(f"/proc/{pid}/status").read_text().splitlines()
            found += [int(one.split()[1]) for one in status if one.startswith("Seccomp_filters:")]
    return max(found)


@pytest.mark.parametrize("way", ["prctl", "seccomp"])
def test_system_call_filters_cannot_be_stacked(jail: OpenJail, way: str) -> None:
    """Each is up to 4096 instructions of the kernel's memory, which no process's account shows."""
    with jail.inside("where_am_i", {}) as run:
        ours = most_filters(run)
    assert ours, "this kernel does not count them"
    jail.attack(
        f"stack system call filters: {way}",
        "stack_filters",
        lambda run: most_filters(run) > ours + 2,
        way=way,
    )


@pytest.mark.parametrize("abi", ["i386", "x32"])
def test_other_numbering_schemes_are_closed(arena: Arena, abi: str) -> None:
    """Calls by i386 numbers (int 0x80) and x32 numbers do not go around the filter."""
    renamed = new_alias()
    with control_run("foreign_abi", {"alias": renamed, "abi": abi}) as probe:
        works = bool(pids_named(renamed))
        why = "" if works else f"this kernel has no such numbers: {probe.text.strip()[:60]}"
    name = {"i386": "int 0x80 (i386 numbers)", "x32": "x32 numbers"}[abi]
    arena.attack(
        name,
        "foreign_abi",
        lambda run: pids_named(renamed),
        before=lambda: end(renamed),
        impossible=why,
        alias=renamed,
        abi=abi,
    )


def test_setuid_programs_gain_nothing(jail: OpenJail) -> None:
    uid = None if USER == "user" else 65533
    arguments = {"command": ["/usr/bin/su", "-c", "true"], "uid": uid, "inside": {"uid": None}}
    jail.attack("run a set-user-id program (su)", "setuid_program", became_root, **arguments)


def test_setuid_copies_gain_nothing(arena: Arena, home: Path) -> None:
    program = home / "granted" / "sleep"
    program.parent.mkdir()
    shutil.copy("/bin/sleep", program)
    program.chmod(0o4755)
    arena.attack(
        "run a set-user-id program (in a granted folder)",
        "setuid_program",
        became_root,
        policy={"readable": (str(program.parent),)},
        command=[str(program), "60"],
        uid=65533,
        inside={"uid": None},
        impossible="" if USER == "root" else "only root can make one",
    )


def became_root(run: Run) -> bool:
    """Whether a child of the payload acts as root without being it."""
    children = [child for pid in run.pids() for child in psutil.Process(pid).children()]
    return eventually(lambda: any(map(acts_as_root, children)), 2.0 if run.inside else 60.0)


def acts_as_root(process: psutil.Process) -> bool:
    """Whether its effective user is root and its real one is not."""
    with contextlib.suppress(psutil.NoSuchProcess):
        uids = process.uids()
        return uids.effective == 0 != uids.real
    return False

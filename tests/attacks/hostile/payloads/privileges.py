"""Gain rights, or a way into the kernel."""

import ctypes
import errno
import mmap
import os
import platform
import signal
import struct
import tempfile
import time

from payloads.kernel import (
    CLONE_NEWNS,
    CLONE_NEWUSER,
    become_root_of_a_namespace,
    in_child,
    number,
    syscall,
)
from payloads.running import call_me

_REMOUNT, _BIND, _PRIVATE = 0x20, 0x1000, 0x44000
_NOSUID, _NODEV, _NOEXEC = 2, 4, 8
kept = []
_PR_SET_NAME = 15
_MAP_32BIT = 0x40
_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _FILTER = 38, 22, 2
_LENGTH = 4096
_LIBC = ctypes.CDLL(None, use_errno=True)


def user_namespace(alias):
    """Become root of a user namespace: the way to most of the kernel's code."""
    return in_child(alias, lambda: syscall("unshare", CLONE_NEWUSER))


def clone_with_namespace(alias, way):
    """Become root of a user namespace, asked for in memory where a filter cannot look (clone3)."""
    if way == "clone3":
        words = (ctypes.c_uint64 * 8)(CLONE_NEWUSER, 0, 0, 0, signal.SIGCHLD)
        child = syscall("clone3", words, ctypes.sizeof(words))
    else:
        child = syscall("clone", CLONE_NEWUSER | signal.SIGCHLD, 0, 0, 0, 0)
    if child == 0:
        call_me(alias)
        time.sleep(120)
        os._exit(0)
    return child


def chroot(alias):
    def change():
        try:
            os.chroot(tempfile.mkdtemp())
        except PermissionError:
            become_root_of_a_namespace(CLONE_NEWNS)
            os.chroot(tempfile.mkdtemp())

    return in_child(alias, change)


def pivot_root(alias):
    def pivot():
        place = tempfile.mkdtemp().encode()
        try:
            become_root_of_a_namespace(CLONE_NEWNS)
        finally:
            syscall("mount", b"none", b"/", b"", _PRIVATE, 0)
            syscall("mount", place, place, b"", _BIND, 0)
            os.mkdir(place + b"/old")
            syscall("pivot_root", place, place + b"/old")

    return in_child(alias, pivot)


def mount_tmpfs(alias, source):
    place = tempfile.mkdtemp()

    def work():
        # Not to be seen by anybody else, where this works.
        become_root_of_a_namespace(CLONE_NEWNS)
        syscall("mount", b"none", b"/", b"", _PRIVATE, 0)

    def mount():
        try:
            work()
        except OSError as error:
            failed = str(error)
        else:
            failed = ""
        syscall("mount", source.encode(), place.encode(), b"tmpfs", 0, b"size=64k")
        return failed

    return in_child(alias, mount)


def remount_root(alias):
    def remount():
        answers = []
        try:
            become_root_of_a_namespace(CLONE_NEWNS)
            syscall("mount", b"none", b"/", b"", _PRIVATE, 0)
        except OSError as error:
            answers.append(str(error))
        for flags in (0, _NODEV | _NOSUID, _NODEV | _NOSUID | _NOEXEC):
            try:
                syscall("mount", b"none", b"/", b"", _REMOUNT | _BIND | flags, 0)
                answers.append("remounted")
            except OSError as error:
                answers.append(str(error))
        return answers

    return in_child(alias, remount)


def answers(calls):
    """Call parts of the kernel that such a program never needs, with arguments that do nothing.
    What comes back tells whether the call got there."""
    answers = {}
    for name, arguments in calls.items():
        if number(name) is None:
            answers[name] = "not on this machine"
            continue
        try:
            answers[name] = str(syscall(name, *arguments))
        except OSError as error:
            answers[name] = errno.errorcode.get(error.errno, str(error.errno))
    return answers


def kernel_object(kind):
    """Make a descriptor of one of the kernel's larger machines, and keep it."""
    kept.append(_MAKERS[kind]())


def _bpf():
    return syscall("bpf", 0, struct.pack("=IIIII", 2, 4, 8, 1, 0).ljust(72, b"\0"), 72)


def _io_uring():
    return syscall("io_uring_setup", 4, ctypes.create_string_buffer(120))


def _userfaultfd():
    return syscall("userfaultfd", 1)  # for faults in user space only


def _perf():
    # A software clock of this process, without the kernel's part.
    attributes = struct.pack("=IIQQQQQ", 1, 64, 1, 0, 0, 0, 0x60).ljust(64, b"\0")
    return syscall("perf_event_open", attributes, 0, -1, -1, 0)


def _fanotify():
    return syscall("fanotify_init", 0x200, 0)  # FAN_REPORT_FID: for plain users too


def _fsopen():
    return syscall("fsopen", b"tmpfs", 0)


_MAKERS = {
    "bpf": _bpf,
    "io_uring": _io_uring,
    "userfaultfd": _userfaultfd,
    "perf_event": _perf,
    "fanotify": _fanotify,
    "fscontext": _fsopen,
}


def foreign_abi(alias, abi):
    """Call the kernel by another architecture's numbers: a filter that forgets to check is blind.
    The call sets this process's name, which shows from outside."""
    if platform.machine() != "x86_64":
        raise OSError("this machine has no other architecture's numbers")
    kind = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_32BIT
    rwx = mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC
    area = mmap.mmap(-1, 4096, flags=kind, prot=rwx)
    address = ctypes.addressof(ctypes.c_char.from_buffer(area))
    name = alias.encode() + b"\0"
    area[2048 : 2048 + len(name)] = name
    code = _i386(address + 2048) if abi == "i386" else _x32(address + 2048)
    area[: len(code)] = code
    return ctypes.CFUNCTYPE(ctypes.c_long)(address)()


def _i386(name):
    # push rbx; mov eax, 172 (prctl); mov ebx, 15; mov ecx, name; int 0x80; pop rbx; ret
    words = struct.pack("<BIBIBI", 0xB8, 172, 0xBB, _PR_SET_NAME, 0xB9, name)
    return b"\x53" + words + b"\xcd\x80\x5b\xc3"


def _x32(name):
    # mov eax, x32 | 157 (prctl); mov edi, 15; mov esi, name; syscall; ret
    words = struct.pack("<BIBIBI", 0xB8, 0x40000000 | 157, 0xBF, _PR_SET_NAME, 0xBE, name)
    return words + b"\x0f\x05\xc3"


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def stack_filters(way):
    load, allow = struct.pack("=HBBI", 0x20, 0, 0, 0), struct.pack("=HBBI", 6, 0, 0, 0x7FFF0000)
    code = ctypes.create_string_buffer(load * (_LENGTH - 1) + allow)
    program = _Program(_LENGTH, ctypes.addressof(code))
    _LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    count = 0
    while _installed(way, ctypes.addressof(program)):
        count += 1
    return count


def _installed(way, place):
    if way == "prctl":
        return _LIBC.prctl(_PR_SET_SECCOMP, _FILTER, ctypes.c_ulong(place), 0, 0) == 0
    try:
        return syscall("seccomp", 1, 0, place) == 0
    except OSError:
        return False

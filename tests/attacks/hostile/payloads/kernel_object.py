"""Make a descriptor of one of the kernel's larger machines, and keep it."""

import ctypes
import struct

from payloads.kernel import syscall

kept = []


def attack(kind):
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

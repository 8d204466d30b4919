"""Take memory of one kind, a piece at a time, and keep it."""

import contextlib
import ctypes
import fcntl
import mmap
import os
import re
import select
import socket
import struct
import tempfile
import time

from payloads.kernel import syscall

kept = []
_PIECE = 8 << 20
_SMALL = 512 << 10
_IPC_PRIVATE, _IPC_RMID = 0, 0
_PAGE = mmap.PAGESIZE
_LIBC = ctypes.CDLL(None, use_errno=True)


def memory_bomb(kind, size):
    take = globals()["_" + re.sub(r"\W+", "_", kind).lower()]
    taken = [take() for _ in range(size // _PIECE)]
    kept.append(taken)
    if kind in _FOLDERS:
        return taken
    return [number for piece in taken for number in piece] if kind in _LEFT_BEHIND else None


def _heap():
    return b"x" * _PIECE


def _shared(size=_PIECE):
    area = mmap.mmap(-1, size, flags=mmap.MAP_SHARED | mmap.MAP_ANONYMOUS)
    area.write(b"x" * size)
    return area


def _memfd():
    fd = os.memfd_create("bomb")
    os.write(fd, b"x" * _PIECE)
    return fd


def _memfd_without_a_descriptor():
    fd = _memfd()
    area = mmap.mmap(fd, _PIECE)
    os.close(fd)
    return area


def _shared_in_small_pieces():
    """Below whatever size might be looked at."""
    return [_shared(_SMALL) for _ in range(_PIECE // _SMALL)]


def _shared_out_of_the_page_tables():
    """Its pages leave the page tables, and are there."""
    area = _shared()
    area.madvise(mmap.MADV_DONTNEED)
    return area


def _shared_unmapped_but_for_a_page():
    """One page of it is mapped, and keeps the others."""
    pieces = _shared_in_small_pieces()
    for area in pieces:
        address = ctypes.addressof(ctypes.c_char.from_buffer(area))
        _checked(_LIBC.munmap(ctypes.c_void_p(address + _PAGE), ctypes.c_size_t(_SMALL - _PAGE)))
    return pieces


def _checked(result):
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def _copies_of_a_file_s_pages():
    """Changed pages of a file that has no blocks of its own."""
    with tempfile.TemporaryFile() as file:
        os.ftruncate(file.fileno(), _PIECE)
        area = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    for at in range(0, _PIECE, _PAGE):
        area[at] = 1
    return area


def _page_tables():
    """One page of table for each 2 MiB that are only read."""
    size = _PIECE // _PAGE * (2 << 20)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    area = mmap.mmap(-1, size, flags=flags, prot=mmap.PROT_READ)
    area.madvise(mmap.MADV_NOHUGEPAGE)
    for at in range(0, size, 2 << 20):
        area[at]
    return area


def _mappings():
    """Each page of an area a mapping of its own, in a process of its own."""

    def split():
        area = mmap.mmap(-1, 60000 * _PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        address = ctypes.addressof(ctypes.c_char.from_buffer(area))
        for at in range(0, len(area), 2 * _PAGE):
            _checked(_LIBC.mprotect(ctypes.c_void_p(address + at), _PAGE, mmap.PROT_READ))
        return area

    return _in_child(split)


def _semaphores():
    return [_checked(_LIBC.semget(_IPC_PRIVATE, 500, 0o1600)) for _ in range(_PIECE // (32 << 10))]


def _messages():
    """As many as a queue takes, in many queues."""
    message = ctypes.create_string_buffer(8 + 1)
    message[0] = 1
    queues = []
    for _ in range(8):
        queue = _checked(_LIBC.msgget(_IPC_PRIVATE, 0o1600))
        queues.append(queue)
        with contextlib.suppress(BlockingIOError):
            while True:
                _checked(_LIBC.msgsnd(queue, message, ctypes.c_size_t(1), 0o4000))
    return queues


def _sockets():
    """Many small messages, which cost most, each way through pairs of sockets."""
    return [_full_pair() for _ in range(_PIECE // (400 << 10))]


def _full_pair():
    pair = socket.socketpair()
    for one in pair:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 << 20)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 208 << 10)
        one.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                one.send(b"x")
    return pair


def _sockets_in_flight():
    """The same, held by nothing but another socket that holds them."""
    ours, theirs = socket.socketpair()
    for _ in range(_PIECE // (400 << 10)):
        pair = _full_pair()
        socket.send_fds(ours, [b"x"], [one.fileno() for one in pair])
        for one in pair:
            one.close()
    return ours, theirs


def _epoll_watches():
    if not kept:
        kept.append([os.eventfd(0) for _ in range(500)])
    events = [select.epoll() for _ in range(_PIECE // (500 * 200))]
    for one in events:
        for fd in kept[0]:
            one.register(fd, select.EPOLLIN)
    return events


def _file_locks():
    """Of single bytes that do not touch, some in each of many files."""
    files = []
    for _ in range(_PIECE // (300 * 180)):
        file = tempfile.TemporaryFile()  # noqa: SIM115
        for at in range(300):
            fcntl.lockf(file, fcntl.LOCK_SH, 1, 2 * at)
        files.append(file)
    return files


_LONG_NAME = "n" * 200


def _in_memory():
    """A folder of its own in a file system of memory, where there is one."""
    return tempfile.mkdtemp(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None)


def _empty_folders():
    """They hold no block: all that they take is the kernel's own memory."""
    folder = _in_memory()
    for number in range(_PIECE // 800):
        os.mkdir(f"{folder}/{number}{_LONG_NAME}")
    return folder


def _attributes_of_files():
    return _attributed("user.bomb", b"x" * 60000)


def _access_lists():
    """As many entries as a list may have, all for one user."""
    named = [(2, 7, os.getuid())] * 8180
    entries = [(1, 7, 0xFFFFFFFF), *named, *((tag, 5, 0xFFFFFFFF) for tag in (4, 16, 32))]
    packed = b"".join(struct.pack("<HHI", *entry) for entry in entries)
    return _attributed("system.posix_acl_access", struct.pack("<I", 2) + packed)


def _attributed(name, value):
    folder = _in_memory()
    for number in range(_PIECE // 60000):
        path = f"{folder}/{number}"
        os.close(os.open(path, os.O_CREAT | os.O_WRONLY, 0o600))
        os.setxattr(path, name, value)
    return folder


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
    held, pipes = 0, []
    while held < _PIECE:
        read, write = os.pipe2(os.O_NONBLOCK)
        held += os.write(write, b"x" * 65536)
        pipes.append((read, write))
    return pipes


def _children():
    """A little each, in many processes."""
    return _in_child(_heap)


def _in_child(take):
    ready, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            kept.append(take())
            os.write(told, b"x")
            time.sleep(300)
        finally:
            os._exit(0)
    os.close(told)
    os.read(ready, 1)
    os.close(ready)
    return pid


#: Their numbers, or paths, are needed to remove them.
_FOLDERS = ("empty folders", "attributes of files", "access lists")
_LEFT_BEHIND = ("semaphores", "messages")

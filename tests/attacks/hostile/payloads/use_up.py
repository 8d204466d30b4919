"""Use up what the kernel gives to a user, all programs together."""

import contextlib
import ctypes
import os
import resource
import signal
import socket

kept = []
_LIBC = ctypes.CDLL(None, use_errno=True)
_MOST = 1 << 20
_IN_FLIGHT = 512
"""Far above what is judged by, and below what this user's other programs are allowed by default:
above that none of them could send any, and what they want to send is lost."""


def attack(kind, name):
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if kind == "pages of pipes":
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    if kind == "descriptors in flight":
        resource.setrlimit(resource.RLIMIT_NOFILE, (_IN_FLIGHT, hard))
    return {
        "inotify instances": _inotify,
        "queued signals": _signals,
        "message queues": lambda: _queues(name),
        "descriptors in flight": _descriptors,
        "pages of pipes": _pipes,
    }[kind]()


def _until_refused(call):
    return next((n for n in range(_MOST) if call(n) < 0), _MOST)


def _inotify():
    return _until_refused(lambda n: _LIBC.inotify_init1(0))


def _signals():
    number = signal.SIGRTMIN + 5
    signal.pthread_sigmask(signal.SIG_BLOCK, [number])
    return _until_refused(lambda n: _LIBC.sigqueue(os.getpid(), number, None))


def _queues(name):
    def make(n):
        path = f"/{name}-{n}".encode()
        queue = _LIBC.mq_open(path, os.O_CREAT | os.O_RDWR, 0o600, None)
        _LIBC.mq_unlink(path)
        return queue

    return _until_refused(make)


def _descriptors():
    fd = os.open("/dev/null", os.O_RDONLY)
    sent = 0
    with contextlib.suppress(OSError):
        while True:
            pair = socket.socketpair()
            kept.append(pair)
            pair[0].setblocking(False)
            with contextlib.suppress(BlockingIOError):
                for _ in range(_MOST):
                    socket.send_fds(pair[0], [b"x"], [fd] * 50)
                    sent += 50
    return sent


def _pipes():
    for _ in range(1500):
        kept.append(os.pipe())

"""Use up what this process shares with others; ``memory_bomb`` is for memory."""

import contextlib
import ctypes
import fcntl
import os
import resource
import signal
import socket
import tempfile
import threading
import time

kept = []
_PIECE = 1 << 20
_LIBC = ctypes.CDLL(None, use_errno=True)
_MOST = 1 << 20
_IN_FLIGHT = 512
"""Far above what is judged by, and below what this user's other programs are allowed by default:
above that none of them could send any, and what they want to send is lost."""


def fork_bomb(count):
    forked = 0
    for _ in range(count):
        try:
            pid = os.fork()
        except OSError as error:
            return [forked, str(error)]
        if pid == 0:
            try:
                time.sleep(300)
            finally:
                os._exit(0)
        forked += 1
    return forked


def thread_bomb(count):
    for _ in range(count):
        thread = threading.Thread(target=threading.Event().wait, args=(300,), daemon=True)
        thread.start()
        kept.append(thread)
    return count


def spin(seconds):
    """Burn processor time, and ignore the polite request to stop."""
    signal.signal(signal.SIGXCPU, signal.SIG_IGN)
    while time.process_time() < seconds:
        pass
    return time.process_time()


def flood(size):
    line = b"x" * 8191 + b"\n"
    written = 0
    while written < size:
        written += os.write(1, line)
        written += os.write(2, line)
    return written


def fill_disk(folders, size):
    own = [os.environ.get("HOME", "/"), tempfile.gettempdir(), os.getcwd(), "/dev/shm"]
    written = {}
    for folder in folders or own:
        path = os.path.join(folder, f"fill-{os.getpid()}")
        done = 0
        try:
            with open(path, "wb", 0) as file:
                while done < size:
                    done += file.write(b"x" * _PIECE)
        except OSError as error:
            written[folder] = [path, done, str(error)]
        else:
            written[folder] = [path, done, ""]
    return written


def fill_inodes(folders, count):
    own = [os.environ.get("HOME", "/"), tempfile.gettempdir(), os.getcwd(), "/dev/shm"]
    made = {}
    for folder in folders or own:
        try:
            place = tempfile.mkdtemp(dir=folder)
            made[folder] = [place, 0, ""]
            for index in range(count):
                os.close(os.open(f"{place}/{index}", os.O_CREAT | os.O_WRONLY, 0o600))
                made[folder][1] += 1
        except OSError as error:
            made.setdefault(folder, ["", 0, ""])[2] = str(error)
    return made


def large_pipe(size):
    kept.append(os.pipe())
    fcntl.fcntl(kept[-1][1], 1031, size)  # F_SETPIPE_SZ


def terminals(count):
    """Open pseudo terminals, which the kernel counts for all users together, and keep them."""
    for number in range(count):
        try:
            kept.append(os.openpty())
        except OSError as error:
            return [number, str(error)]
    return [count, ""]


def use_up(kind, name):
    """Use up what the kernel gives to a user, all programs together."""
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

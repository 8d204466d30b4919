"""Read, change, stop and outlive other processes."""

import contextlib
import ctypes
import fcntl
import os
import resource
import signal
import socket
import struct
import subprocess
import tempfile
import termios
import threading
import time

from payloads.kernel import CLONE_NEWUSER, in_child, syscall
from payloads.running import call_me

_POKEDATA, _ATTACH, _DETACH = 5, 16, 17
kept = []
_victim = {"signals": 0, "broadcasts": 0}
_PR_SET_PDEATHSIG = 1


def signal_one(pid, way):
    """Send a signal to the client in each of the ways that there are."""
    if way == "kill":
        os.kill(pid, signal.SIGURG)
    elif way == "sigqueue":
        information = struct.pack("=iiii", signal.SIGURG, 0, -1, 0).ljust(128, b"\0")
        syscall("rt_sigqueueinfo", pid, signal.SIGURG, information)
    elif way == "pidfd":
        syscall("pidfd_send_signal", syscall("pidfd_open", pid, 0), signal.SIGURG, None, 0)
    else:
        ours, theirs = socket.socketpair()
        fcntl.fcntl(ours, fcntl.F_SETOWN, pid)
        fcntl.fcntl(ours, 10, signal.SIGURG)  # F_SETSIG
        fcntl.fcntl(ours, fcntl.F_SETFL, os.O_ASYNC)
        theirs.send(b"x")


def signal_all():
    """Send a signal to every process that may be reached: one that nobody minds.
    It is not the one that those who are attacked one by one count."""
    os.kill(-1, signal.SIGWINCH)


def stop_processes(pids, own):
    """Stop the processes that watch over this one: what is stopped enforces nothing."""
    errors = []
    for pid in [*pids, *([1, os.getppid()] if own else [])]:
        try:
            os.kill(pid, signal.SIGSTOP)
        except OSError as error:
            errors.append(f"{pid}: {error}")
    init = os.getppid()
    if own and os.fork() == 0:  # a signal to the own group is not addressed to anybody else
        with contextlib.suppress(OSError):
            os.setpgid(0, init)
            os.kill(0, signal.SIGSTOP)
        os._exit(0)
    return errors


def ptrace_poke(pid, address, word):
    """Attach to a process as a debugger and write into its memory."""
    syscall("ptrace", _ATTACH, pid, 0, 0)
    os.waitpid(pid, 0x40000000)  # __WALL
    try:
        syscall("ptrace", _POKEDATA, pid, address, word)
    finally:
        syscall("ptrace", _DETACH, pid, 0, 0)


def _process_vm(way, pid, address, buffer, size):
    ours = (ctypes.c_ulong * 2)(ctypes.addressof(buffer), size)
    theirs = (ctypes.c_ulong * 2)(address, size)
    syscall(f"process_vm_{way}v", pid, ours, 1, theirs, 1, 0)
    return buffer.raw.decode("ascii", "replace")


def process_vm_read(pid, address, size):
    return _process_vm("read", pid, address, ctypes.create_string_buffer(size), size)


def process_vm_write(pid, address, message):
    buffer = ctypes.create_string_buffer(message.encode())
    _process_vm("write", pid, address, buffer, len(message))


def proc_mem_read(pid, address, size):
    with open(f"/proc/{pid}/mem", "rb", 0) as memory:
        return os.pread(memory.fileno(), size, address).decode("ascii", "replace")


def proc_mem_write(pid, address, message):
    fd = os.open(f"/proc/{pid}/mem", os.O_RDWR)
    os.pwrite(fd, message.encode(), address)


def proc_maps(pid):
    """Learn where another process keeps what."""
    with open(f"/proc/{pid}/maps") as file:
        return file.read()


def proc_fd(pid, fd):
    copy = os.open(f"/proc/{pid}/fd/{fd}", os.O_RDONLY)
    return os.pread(copy, 4096, 0).decode("ascii", "replace")


def pidfd_getfd(pid, fd):
    copy = syscall("pidfd_getfd", syscall("pidfd_open", pid, 0), fd, 0)
    return os.pread(copy, 4096, 0).decode("ascii", "replace")


def prlimit(pid, files):
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    limits = struct.pack("=QQ", files, hard & (2**64 - 1))
    syscall("prlimit64", pid, resource.RLIMIT_NOFILE, limits, None)


def oom_score(pid, score):
    with open(f"/proc/{pid}/oom_score_adj", "w") as file:
        file.write(str(score))


def setpriority(pid, nice):
    os.setpriority(os.PRIO_PROCESS, pid, nice)


def ioprio_set(pid, priority):
    syscall("ioprio_set", 1, pid, priority)


def sched_setaffinity(pid, cpus):
    os.sched_setaffinity(pid, cpus)


def sched_setscheduler(pid):
    os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def enter_namespaces(alias, pid):
    def enter():
        try:
            syscall("setns", syscall("pidfd_open", pid, 0), CLONE_NEWUSER)
        except OSError:
            syscall("setns", os.open(f"/proc/{pid}/ns/user", os.O_RDONLY), CLONE_NEWUSER)

    return in_child(alias, enter)


def be_victim(secret):
    """Be what another jail attacks: hold a secret everywhere, count signals; not an attack."""
    if secret is None:
        came = {name: _victim[name] for name in ("signals", "broadcasts")}
        return {**came, "text": _victim["buffer"].raw.decode("ascii", "replace")}
    ctypes.CDLL(None).prctl(0x59616D61, ctypes.c_ulong(-1), 0, 0, 0)  # PR_SET_PTRACER
    signal.signal(signal.SIGURG, _count)
    signal.signal(signal.SIGWINCH, _count)  # what is sent to everybody
    os.environ["SECRET"] = secret
    _victim["buffer"] = ctypes.create_string_buffer(secret.encode())
    folder = os.path.expanduser("~")
    _victim["file"] = tempfile.NamedTemporaryFile(dir=folder)  # noqa: SIM115
    _victim["file"].write(secret.encode())
    _victim["file"].flush()
    os.chmod(_victim["file"].name, 0o644)
    os.chmod(folder, 0o755)
    return {
        "address": ctypes.addressof(_victim["buffer"]),
        "size": len(secret),
        "fd": _victim["file"].fileno(),
        "path": _victim["file"].name,
    }


def _count(number, _):
    _victim["broadcasts" if number == signal.SIGWINCH else "signals"] += 1


def daemon(alias):
    """Leave a process behind that nobody is the parent of, and that asks for no death signal."""
    read, write = os.pipe()
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, 0, 0, 0, 0)
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
                signal.signal(number, signal.SIG_IGN)
            call_me(alias)
            os.write(write, b"x")
            os.closerange(0, 256)
            time.sleep(300)
        os._exit(0)
    os.read(read, 1)


def leaderless(alias):
    """Leave a process behind whose main thread has ended: it looks like a zombie, and runs on."""
    read, write = os.pipe()
    if os.fork() == 0:
        os.setsid()
        call_me(alias)
        threading.Thread(target=_run_on, args=(write,)).start()
        ctypes.CDLL(None).pthread_exit(None)
    os.read(read, 1)


def _run_on(write):
    ctypes.CDLL(None).pthread_join(ctypes.c_ulong(threading.main_thread().ident), None)
    os.write(write, b"x")
    os.closerange(0, 256)
    time.sleep(300)


def grandchildren(alias, seconds):
    """Keep forking away: by the time that one process is found, it is another one."""
    if os.fork() == 0:
        os.setsid()
        call_me(alias)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.05)  # a test must be able to see it, too
            if os.fork() != 0:
                os._exit(0)
        os._exit(0)
    time.sleep(0.1)


def setuid_program(command, uid):
    """Run a program that belongs to another user and takes on its rights, and let it stand."""
    user = {} if uid is None else {"user": uid}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    kept.append(subprocess.Popen(command, stdin=subprocess.PIPE, **silent, **user))
    return kept[-1].pid


def write_to_terminal(text, ways):
    """Write to the terminal that the client was started from."""
    return _first(
        ways, lambda way: os.write(os.open(way, os.O_WRONLY | os.O_NOCTTY), text.encode())
    )


def _first(ways, act):
    errors = []
    for way in ways:
        try:
            return act(way)
        except OSError as error:
            errors.append(str(error))
    return errors


def type_into_terminal(text):
    """Type a command into the terminal that the client was started from."""

    def typed(way):
        fd = os.open(way, os.O_RDWR | os.O_NOCTTY) if isinstance(way, str) else way
        for letter in text:
            fcntl.ioctl(fd, termios.TIOCSTI, letter.encode())

    return _first(("/dev/tty", 0, 1, 2), typed)

"""Python as on macOS or on Windows, as far as it can be had on Linux. Run by its path::

    python -I interpreter.py darwin|win32 -c CODE [ARGUMENT]...
    python -I interpreter.py darwin|win32 -m MODULE [ARGUMENT]...

What is not ours runs as it is, for it has releases of its own for these platforms. Our own modules
see ``sys.platform`` as it is there, none of the names that the standard library does not have
there, and no ``/proc`` or ``/sys``. On Windows, further: text files end their lines with two
characters and are read as cp1252 unless something else is said, a mode says whether a file can be
written and no more, a file that is read-only cannot be removed, a folder not be opened, ZeroMQ and
``select`` wait for sockets alone, a child is handed no descriptors, and needs ``SYSTEMROOT``.

What cannot be had: drive letters and backslashes, a file system without case, locks by
``msvcrt``, which are those of Linux here, and that a file that is open cannot be renamed.
"""

import builtins
import importlib
import io
import os
import platform
import runpy
import select
import shutil
import signal
import socket
import stat
import subprocess
import sys
import sysconfig
import types
from typing import Any

_SHARED = ("attachment", "column_lane", "lane")
LINUX_ALONE = (
    "envhub_sandbox.extras.packages.for_a_server",
    "envhub_sandbox.extras.docker.monitor",
    "envhub_sandbox.extras.ray.actor",
    *(f"envhub_sandbox.transport.shared_memory.{name}" for name in _SHARED),
    "envhub_worker.protocol.shared_memory.descriptors",
)
"""Of the client, what a client elsewhere never imports; tests may."""

# what asks for its platform while it is imported
_BEFORE = """
    asyncio concurrent.futures ctypes multiprocessing ssl tempfile webbrowser click cloudpickle
    filelock gymnasium gymnasium.vector huggingface_hub huggingface_hub.file_download
    huggingface_hub.hf_api msgpack numpy packaging packaging.requirements packaging.tags
    rich.console rich.progress rich.table typer.rich_utils typer.testing uv yaml zmq
    zmq.utils.monitor shellingham rich.live rich.status pyproject_hooks psutil lz4.frame
"""
_LINUX_ALONE = {
    "os": """
        memfd_create MFD_CLOEXEC MFD_ALLOW_SEALING pidfd_open P_PIDFD waitid eventfd
        eventfd_read eventfd_write EFD_CLOEXEC EFD_NONBLOCK pipe2 sched_getaffinity
        sched_setaffinity sched_setscheduler sched_getscheduler getxattr setxattr listxattr
        removexattr O_PATH O_TMPFILE splice posix_fadvise posix_fallocate copy_file_range
        getrandom getresuid unshare setns
    """,
    "select": "epoll EPOLLIN EPOLLET EPOLLOUT EPOLL_CLOEXEC",
    "signal": "sigtimedwait sigwaitinfo pidfd_send_signal SIGPWR SIGRTMIN",
    "socket": """
        SO_PEERCRED SOCK_CLOEXEC SOCK_NONBLOCK SOCK_SEQPACKET MSG_NOSIGNAL
    """,
    "resource": "prlimit RLIMIT_NICE RLIMIT_SIGPENDING",
    "time": "CLOCK_BOOTTIME",
    "ctypes": "CDLL PyDLL",
}
_UNIX_ALONE = {
    "os": """
        fork forkpty register_at_fork getuid geteuid getgid getegid setuid getgroups getpgrp
        getpgid setpgid setsid getsid killpg nice chown fchown lchown fchmod mkfifo mknod
        statvfs fstatvfs ST_RDONLY pread pwrite preadv pwritev uname sync fdatasync major minor
        O_NOFOLLOW O_DIRECTORY O_NONBLOCK O_CLOEXEC O_SYNC O_NOCTTY WNOHANG WEXITED WNOWAIT
        WIFSIGNALED WTERMSIG wait wait3 wait4 P_PID CLD_EXITED CLD_KILLED CLD_DUMPED openpty
        ttyname tcgetpgrp confstr sysconf getloadavg posix_spawn chroot fchdir lockf sendfile
    """,
    "select": "poll POLLIN POLLOUT POLLHUP",
    "signal": """
        SIGKILL SIGALRM SIGHUP SIGPROF SIGXFSZ SIGXCPU SIGUSR1 SIGCHLD SIGPIPE SIGSTOP SIGCONT
        SIGTSTP alarm setitimer getitimer pause ITIMER_REAL ITIMER_PROF pthread_kill
        pthread_sigmask sigwait siginterrupt
    """,
    "socket": "AF_UNIX send_fds recv_fds MSG_DONTWAIT SCM_RIGHTS CMSG_LEN",
    "time": "tzset clock_gettime CLOCK_REALTIME CLOCK_MONOTONIC",
}
_NO_MODULES = {
    "darwin": {"spwd", "_posixshmem"},
    "win32": {"fcntl", "grp", "pwd", "resource", "termios", "tty", "pty", "syslog", "readline"},
}


def is_ours(frame: Any) -> bool:
    """Whether a frame is of one of the client's modules."""
    name = str(frame.f_globals.get("__name__", ""))
    client = name.startswith(("envhub_sandbox", "envhub_worker.protocol"))
    return client and name not in LINUX_ALONE


def become(system: str) -> None:
    """From here on this process is one of that system."""
    for name in _BEFORE.split():
        try:
            importlib.import_module(name)
        except ImportError:  # an extra, or another release of it
            continue
    sysconfig.get_config_vars()  # from a file whose name has the platform
    sys.platform = system
    machine = {"darwin": "arm64", "win32": "AMD64"}[system]
    called = {"darwin": "Darwin", "win32": "Windows"}[system]
    platform.uname = lambda: platform.uname_result(called, "there", "1", "1", machine)
    platform.libc_ver = lambda *_, **__: ("", "")
    for module, names in _LINUX_ALONE.items():
        too = _UNIX_ALONE.get(module, "") if system == "win32" else ""
        _hide(importlib.import_module(module), {*names.split(), *too.split()})
    _refuse_imports(_NO_MODULES[system])
    _hide_kernel_files()
    if system == "win32":
        home = os.path.expanduser("~")
        os.environ |= {
            "SYSTEMROOT": r"C:\Windows",
            "USERPROFILE": home,
            "APPDATA": f"{home}/AppData/Roaming",
            "LOCALAPPDATA": f"{home}/AppData/Local",
        }
        _windows_files()
        _windows_processes()
        _windows_sockets()
        _windows_locks()
    import platformdirs

    importlib.reload(platformdirs)
    if system == "win32":
        from platformdirs import windows

        vars(windows)["_RESOLVE_WIN_FOLDER"] = windows.get_win_folder_from_env_vars


def _hide(module: Any, names: set[str]) -> None:
    """Keep names of a module from our modules."""

    class Elsewhere(types.ModuleType):
        def __getattribute__(self, name: str) -> Any:
            if name in names and is_ours(sys._getframe(1)):
                raise AttributeError(f"module {module.__name__!r} has no attribute {name!r} there")
            return super().__getattribute__(name)

    module.__class__ = Elsewhere


def _refuse_imports(gone: set[str]) -> None:
    before = builtins.__import__

    def imported(name: str, *rest: Any, **named: Any) -> Any:
        if name in gone and is_ours(sys._getframe(1)):
            raise ModuleNotFoundError(f"No module named {name!r} there", name=name)
        return before(name, *rest, **named)

    builtins.__import__ = imported


def _is_kernels(path: object) -> bool:
    try:
        text = os.fsdecode(path)
    except TypeError:
        return False
    return text.startswith(("/proc/", "/sys/")) or text in ("/proc", "/sys")


def _hide_kernel_files() -> None:
    def look(event: str, given: tuple[Any, ...]) -> None:
        if event in ("open", "os.listdir", "os.scandir") and _is_kernels(given[0]):
            raise FileNotFoundError(2, "there is no such file there", given[0])

    sys.addaudithook(look)
    for name in ("stat", "lstat", "readlink", "access"):
        setattr(os, name, _without_kernels(getattr(os, name)))


def _without_kernels(call: Any) -> Any:
    def asked(path: Any, *rest: Any, **named: Any) -> Any:
        if _is_kernels(path):
            if call.__name__ == "access":
                return False
            raise FileNotFoundError(2, "there is no such file there", path)
        return call(path, *rest, **named)

    asked.__name__ = call.__name__
    return asked


# --- Windows ----------------------------------------------------------------------------------


def _windows_files() -> None:
    opened, stat_of, unlink, replace, rename = os.open, os.stat, os.unlink, os.replace, os.rename

    def is_read_only(path: Any) -> bool:
        try:
            return not stat_of(path, follow_symlinks=False).st_mode & stat.S_IWUSR
        except OSError:
            return False

    def refuse(path: Any) -> None:
        raise PermissionError(13, "Access is denied", path)

    def open_there(path: Any, flags: int, mode: int = 0o777, **named: Any) -> int:
        if is_ours(sys._getframe(1)) and os.path.isdir(path):
            refuse(path)
        return opened(path, flags, mode, **named)

    def unlink_there(path: Any, **named: Any) -> None:
        if not named and is_read_only(path) and not os.path.isdir(path):
            refuse(path)
        unlink(path, **named)

    def replace_there(source: Any, target: Any) -> None:
        if is_read_only(target):
            refuse(target)
        replace(source, target)

    def rename_there(source: Any, target: Any, **named: Any) -> None:
        if os.path.lexists(target):
            raise FileExistsError(17, "the file is there already", target)
        rename(source, target, **named)

    def symlink(source: Any, target: Any, *_: Any, **__: Any) -> None:
        raise OSError(22, "a required privilege is not held by the client", target)

    os.open, os.unlink, os.remove = open_there, unlink_there, unlink_there
    os.replace, os.rename, os.symlink = replace_there, rename_there, symlink
    for name in ("stat", "lstat", "fstat"):
        setattr(os, name, _with_windows_modes(getattr(os, name)))
    text_open = io.open

    def open_text(file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **named: Any) -> Any:
        given = dict(zip(("encoding", "errors", "newline"), rest, strict=False)) | named
        if "b" not in mode:
            if given.get("encoding") in (None, "locale"):
                given["encoding"] = "cp1252"
            if given.get("newline") is None and set(mode) & {"w", "x", "a"}:
                given["newline"] = "\r\n"
        return text_open(file, mode, buffering, **given)

    io.open = builtins.open = open_text


def _with_windows_modes(call: Any) -> Any:
    def asked(*given: Any, **named: Any) -> os.stat_result:
        found = call(*given, **named)
        mode, *rest = found
        if stat.S_ISDIR(mode):
            mode = stat.S_IFDIR | 0o777
        elif stat.S_ISREG(mode):
            mode = stat.S_IFREG | (0o666 if mode & stat.S_IWUSR else 0o444)
        row = [mode, *rest]
        row[4] = row[5] = 0  # user and group
        names = ("st_atime", "st_mtime", "st_ctime", "st_atime_ns", "st_mtime_ns", "st_ctime_ns")
        return os.stat_result(row, {name: getattr(found, name) for name in names})

    return asked


def _windows_processes() -> None:
    subprocess.CREATE_NEW_PROCESS_GROUP = 0x200
    subprocess.STARTUPINFO = lambda: types.SimpleNamespace(dwFlags=0)
    subprocess.STARTF_USESHOWWINDOW = 1
    begin, find = subprocess.Popen.__init__, shutil.which

    def started(self: Any, *given: Any, **named: Any) -> None:
        if named.get("pass_fds") or named.get("preexec_fn"):
            raise ValueError("pass_fds and preexec_fn are not supported on Windows")
        caller = sys._getframe(1)
        while str(caller.f_globals.get("__name__")) == "subprocess":
            caller = caller.f_back
        if is_ours(caller):
            assert not named.get("start_new_session"), "it means nothing on Windows"
            env = named.get("env")
            assert env is None or "SYSTEMROOT" in env, "no program starts without SYSTEMROOT"
        if named.pop("creationflags", 0):
            named["start_new_session"] = True
        named.pop("startupinfo", None)
        begin(self, *given, **named)

    def which(*given: Any, **named: Any) -> str | None:
        sys.platform = "linux"  # for a moment, in which no program's name ends in ".exe"
        try:
            return find(*given, **named)
        finally:
            sys.platform = "win32"

    subprocess.Popen.__init__ = started
    shutil.which = which


def _windows_sockets() -> None:
    import zmq

    selected, registered = select.select, zmq.Poller.register

    def pair(*_: Any) -> tuple[socket.socket, socket.socket]:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            one = socket.create_connection(listener.getsockname())
            return one, listener.accept()[0]

    def refuse_others(one: Any) -> None:
        number = one if isinstance(one, int) else getattr(one, "fileno", lambda: -1)()
        if isinstance(number, int) and number >= 0 and not stat.S_ISSOCK(os.fstat(number).st_mode):
            raise OSError(10038, "an operation was attempted on something that is not a socket")

    def select_there(*given: Any) -> Any:
        for one in (*given[0], *given[1]):
            refuse_others(one)
        return selected(*given)

    def register(self: Any, one: Any, *rest: Any) -> Any:
        if not isinstance(one, zmq.Socket):
            refuse_others(one)
        return registered(self, one, *rest)

    socket.socketpair = pair
    select.select = select_there
    zmq.Poller.register = register


def _windows_locks() -> None:
    """``msvcrt.locking`` by the locks of Linux; without any in Windows' own sense."""
    import fcntl

    msvcrt: Any = types.ModuleType("msvcrt")
    msvcrt.LK_NBLCK, msvcrt.LK_UNLCK = 2, 0

    def locking(descriptor: int, how: int, size: int) -> None:
        assert (os.lseek(descriptor, 0, os.SEEK_CUR), size) == (1 << 30, 1)
        try:
            free = fcntl.LOCK_UN if how == msvcrt.LK_UNLCK else fcntl.LOCK_EX | fcntl.LOCK_NB
            fcntl.flock(descriptor, free)
        except BlockingIOError:
            raise PermissionError(13, "Permission denied") from None

    msvcrt.locking = locking
    sys.modules["msvcrt"] = msvcrt


def main() -> None:
    system, how, what = sys.argv[1:4]
    become(system)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where we are in the background
    sys.argv[1:4] = []
    if how == "-c":
        sys.argv[0] = "-c"
        code = compile(what, "<elsewhere>", "exec")
        exec(code, {"__name__": "__main__", "__builtins__": builtins})
    else:
        sys.argv[0] = what
        runpy.run_module(what, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()

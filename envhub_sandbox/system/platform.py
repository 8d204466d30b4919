"""The differences between Linux, macOS and Windows; our processes and their ends; file names.

Only this module checks which of these systems it runs on.

Jails need Linux. A client of a server on another host or in a container runs on any system, so this
module has substitutes for features that only Linux has.

``OwnerProcess`` is for docs/internals/interruption.md, rule 14. A parent passes its child a pidfd
of itself, or on macOS a pipe that closes when the parent ends; the child watches it. The kernel's
parent death signal would not do: it comes when the thread ends that started the child, and a change
of user clears it. Windows cannot pass descriptors, so it has none of this.

File names differ, too. Repositories are made on Linux, where a name is any bytes. On Windows
``C:\\x`` is a path outside of the folder, ``env.py:x`` a stream of ``env.py``, ``con.py`` a
terminal and ``env.py.`` the file ``env.py``. On most file systems of macOS and Windows, and some of
Linux, ``Env.py`` and ``env.py`` are the same file.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from envhub_worker import protocol

if TYPE_CHECKING:
    import subprocess

T = TypeVar("T")
IS_LINUX: bool = sys.platform == "linux"
IS_WINDOWS: bool = sys.platform == "win32"
NAME: str = {"darwin": "macOS", "win32": "Windows"}.get(sys.platform, sys.platform)

_WINDOWS_VARIABLES = (
    *("SYSTEMROOT", "SYSTEMDRIVE", "COMSPEC", "PATHEXT", "TEMP", "TMP", "USERPROFILE", "APPDATA"),
    *("LOCALAPPDATA", "PROGRAMDATA", "PROGRAMFILES", "PROGRAMFILES(X86)", "PROGRAMW6432"),
)


def user_id() -> int:
    """The effective user's id; -1 on Windows, which has no user ids."""
    number = -1
    if sys.platform != "win32":
        number = os.geteuid()
    return number


def homes_of(path: Path) -> list[Path]:
    """The home directories, without links, of the caller and of the owner of a path; on Windows
    only the caller's.
    """
    homes = [os.path.expanduser("~")]
    if sys.platform != "win32":
        import pwd

        with contextlib.suppress(KeyError, OSError):  # a container knows few of its users
            homes.append(pwd.getpwuid(os.stat(path).st_uid).pw_dir)
    # without a known home it is a bare "~"
    return [Path(os.path.realpath(home)) for home in homes if os.path.isabs(home)]


def own_cpus() -> list[int]:
    """The cores that this thread may use now; a program may restrict them after its imports."""
    cpus = list(range(os.cpu_count() or 1))
    if sys.platform == "linux":
        cpus = sorted(os.sched_getaffinity(0))
    return cpus


def boot_id() -> str:
    """An id that differs after each boot of the kernel; ``"unknown"`` if there is none."""
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return file.read().strip()
    except OSError:
        return "unknown"


def open_flags(*names: str) -> int:
    """Flags of ``os.open`` by name, without those that this platform does not know."""
    flags = 0
    for name in names:
        flags |= getattr(os, name, 0)
    return flags


def own_variables() -> dict[str, str]:
    """The variables that every program on Windows needs; none elsewhere."""
    names = _WINDOWS_VARIABLES if IS_WINDOWS else ()
    return {name: os.environ[name] for name in names if name in os.environ}


def run_after_fork(function: Callable[[], object]) -> None:
    """Have each fork of this process call a function first; Windows has no forks."""
    if sys.platform != "win32":
        os.register_at_fork(after_in_child=function)


def each_after_fork(objects: Iterable[T], function: Callable[[T], object]) -> None:
    """Have each fork of this process call a function for each object that exists then."""

    def forked() -> None:
        for instance in list(objects):
            function(instance)

    run_after_fork(forked)


def own_group() -> dict[str, Any]:
    """Arguments for ``subprocess.Popen``, for a process to which a terminal sends no Ctrl-C."""
    how: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        import subprocess  # imported late, as only Windows needs it and it is slow

        how = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return how


def kill_group(process: subprocess.Popen[Any]) -> None:
    """Kill a process that was started with ``own_group``, and its group on POSIX systems."""
    if sys.platform == "win32":
        process.kill()
    else:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            return  # the whole group has ended


# --- processes of ours

_STREAMS = 3
_pipe: list[int] = []
"""Both ends of a pipe, where there are no pidfds; only this process keeps the second end open."""


class OwnerProcess:
    """The process that made this object.
    ``pid``: its number; compared directly where speed matters.
    """

    def __init__(self) -> None:
        self.pid = os.getpid()

    @property
    def is_here(self) -> bool:
        """Whether this process is the owner, and not a fork of it."""
        return os.getpid() == self.pid


def fork_error_text(owner: int | None = None) -> str:
    """The error's text when an environment is used in a fork of its owner."""
    whose = "this environment belongs to another process"
    if owner is not None:
        whose = f"this environment belongs to process {owner}"
    return f"{whose}, and this is a fork of it ({os.getpid()}); call make_env in this process"


@contextlib.contextmanager
def pidfd() -> Iterator[int]:
    """Yields a pidfd of this process, for a child that is started with it in ``pass_fds``.

    Without pidfds it is a pipe, which reaches its end when this process ends.
    """
    if sys.platform == "linux":
        ourselves = os.pidfd_open(os.getpid())
        try:
            yield ourselves
        finally:
            os.close(ourselves)
    else:
        _pipe[:] = _pipe or os.pipe()
        yield _pipe[0]


def _forget_pipe() -> None:
    """In a fork, close the parent's pipe, which the fork would keep open; it makes its own."""
    while _pipe:
        os.close(_pipe.pop())


if not IS_LINUX:
    run_after_fork(_forget_pipe)


def program(module: str) -> list[str]:
    """The command that runs a module of ours from this very code, which may be a checkout. The
    working directory and environment variables add nothing to its import path.
    """
    packages = Path(__file__).parents[1], Path(protocol.__file__).parents[1]
    folders = sorted({str(package.parent) for package in packages})
    code = (
        f"import runpy, sys; sys.path[3:3] = {folders}; "  # behind the standard library
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-I", "-c", code]


def readable_within(fd: int, timeout_s: float) -> bool:
    """Wait until there is something to read or the other end is closed; returns whether."""
    if sys.platform == "win32":
        return bool(select.select([fd], [], [], timeout_s)[0])
    poll = select.poll()  # select() fails for descriptors above 1023
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(timeout_s * 1000))


def end_with(parent: int, patience_s: float) -> None:
    """End this process, and the group that it leads, as soon as another process has ended.
    ``parent``: a pidfd of the other process.
    ``patience_s``: how long SIGTERM's handler in the main thread may take before the group is
    killed; with 0 it is killed at once.
    """
    os.set_inheritable(parent, False)
    threading.Thread(target=_watch, args=(parent, patience_s), daemon=True).start()


def _watch(parent: int, patience_s: float) -> None:
    if sys.platform != "win32":
        while not readable_within(parent, 3600.0):
            pass
        if patience_s > 0:
            # to the main thread, whose system call it has to interrupt
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            time.sleep(patience_s)
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGKILL)


def has_ended(pid: int) -> bool:
    """Whether a child has ended, reaped or not, even while some of its threads still end."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return True
    # the command's name may have any characters, also parentheses and blanks
    return stat.rpartition(")")[2].split()[0] in "ZX"


def occupy_streams() -> None:
    """Open the descriptors 0, 1 and 2 if the program was started without them: ``<&- >&- 2>&-``.

    Otherwise our first sockets and pipes would get these numbers: prints would go to a worker, and
    a child would lose a descriptor that it is passed to its own standard streams.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) < _STREAMS:  # the lowest free number
        os.set_inheritable(null, True)
    os.close(null)


def replace_missing_streams() -> None:
    """``occupy_streams``, and give ``sys`` its streams, so that ``print`` works in our programs."""
    occupy_streams()
    sys.stdin = sys.stdin or open(os.devnull)  # noqa: SIM115
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


# --- names of files

_RESERVED = (
    r"(?i:con|prn|aux|nul|conin\$|conout\$|(?:com|lpt)[0-9\u00b9\u00b2\u00b3])[ ]*(?:[.:].*)?"
)
_REFUSED = r'[<>:"|?*\\\x00-\x1f]'


def wrong_on_windows(path: str) -> str | None:
    """Why Windows cannot have a file of this name, as the rest of a sentence; None if it can.
    ``path``: relative, with ``/``.
    """
    for step in path.split("/"):
        if match := re.search(_REFUSED, step):
            return f"has {match[0]!r} in its name, which Windows reads as something else"
        if re.fullmatch(_RESERVED, step):
            return f"has the step {step!r}, which is a device on Windows"
        if step.endswith((".", " ")):
            return f"has the step {step!r}, of which Windows drops the end"
    return None


def wrong_here(path: str) -> str | None:
    """The answer of ``wrong_on_windows`` on Windows; None elsewhere."""
    return wrong_on_windows(path) if IS_WINDOWS else None


def taken_as_one(paths: Iterable[str]) -> tuple[str, str] | None:
    """Two paths, or folders above them, that differ only in their case; None if there are none."""
    taken: dict[str, str] = {}
    for path in paths:
        folded = name = ""
        for step in path.split("/"):
            folded, name = f"{folded}/{_folded(step)}", f"{name}/{step}" if name else step
            other = taken.setdefault(folded, name)
            if other != name:
                return other, name
    return None


def _folded(step: str) -> str:
    return unicodedata.normalize("NFD", unicodedata.normalize("NFD", step).casefold())


def ignores_case(folder: Path) -> bool:
    """Whether the file system of a folder ignores the case of names.

    It is tried with a file of ours, since each platform has file systems of both kinds.
    Raises ``OSError``: the folder cannot be written.
    """
    probe = folder / f".envhub-case-{os.urandom(4).hex()}"
    os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    try:
        return os.path.lexists(probe.with_name(probe.name.upper()))
    finally:
        with contextlib.suppress(OSError):
            os.unlink(probe)

"""What differs between Linux, macOS and Windows; processes of ours, and how they end.

This is the one place that asks which of them this is.

Jails need Linux. A client of a server on another host, or of a container, needs nothing of it, so
what Linux alone has is asked for here, with what stands in for it elsewhere.

``OwnerProcess`` is docs/internals/interruption.md, rule 14. A parent hands its child a pidfd of
itself, which the child watches, or on macOS a pipe that ends with it. The kernel's own signal at a
parent's death would come when the thread ends that started the child, and a change of user forgets
it. Windows hands no descriptors on, and has none of this.

Names of files differ, too. A repository is made on Linux, where a name is bytes. On Windows
``C:\\x`` is no name but a place outside of the folder, ``env.py:x`` a part of ``env.py``,
``con.py`` a terminal and ``env.py.`` the file ``env.py``. macOS and Windows take ``Env.py`` and
``env.py`` for one file, unless the file system was made otherwise, and so do some file systems on
Linux.
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
    """The effective user's id; -1 on Windows, which has none."""
    number = -1
    if sys.platform != "win32":
        number = os.geteuid()
    return number


def homes_of(path: Path) -> list[Path]:
    """The home directories of the caller and of whom a file or folder belongs to, without links;
    Windows does not say it of others.
    """
    homes = [os.path.expanduser("~")]
    if sys.platform != "win32":
        import pwd

        with contextlib.suppress(KeyError, OSError):  # a container knows few of its users
            homes.append(pwd.getpwuid(os.stat(path).st_uid).pw_dir)
    # of whom nothing is known it is a bare "~"
    return [Path(os.path.realpath(home)) for home in homes if os.path.isabs(home)]


def cores() -> int:
    """How many processors this process may use."""
    count = os.cpu_count() or 1
    if sys.platform == "linux":
        count = len(os.sched_getaffinity(0))
    return count


def boot_id() -> str:
    """What differs each time the kernel starts; a word where it does not say."""
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
    """Have each fork of this process call a function first; Windows forks none."""
    if sys.platform != "win32":
        os.register_at_fork(after_in_child=function)


def each_after_fork(objects: Iterable[T], function: Callable[[T], object]) -> None:
    """The same of each object that there is then."""

    def forked() -> None:
        for instance in list(objects):
            function(instance)

    run_after_fork(forked)


def own_group() -> dict[str, Any]:
    """For ``subprocess.Popen``: a process to which a terminal sends no Ctrl-C."""
    how: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        import subprocess  # for Windows only: every command would pay for it

        how = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return how


def kill_group(process: subprocess.Popen[Any]) -> None:
    """End a process that was started by ``own_group``, and with it its group where there is one."""
    if sys.platform == "win32":
        process.kill()
    else:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            return  # it has ended, and all that it had started


# --- processes of ours

_STREAMS = 3
_pipe: list[int] = []
"""Of a process without a pidfd of itself: both ends, of which it alone has the second."""


class OwnerProcess:
    """The process that made this.
    ``pid``: its number. Where each step asks, this is compared without a call.
    """

    def __init__(self) -> None:
        self.pid = os.getpid()

    @property
    def is_here(self) -> bool:
        """Whether it is this one, and no fork of it."""
        return os.getpid() == self.pid


def fork_error_text(owner: int | None = None) -> str:
    """The text of the error of an environment that is used in a fork of its owner."""
    whose = "this environment belongs to another process"
    if owner is not None:
        whose = f"this environment belongs to process {owner}"
    return f"{whose}, and this is a fork of it ({os.getpid()}); call make_env in this process"


@contextlib.contextmanager
def pidfd() -> Iterator[int]:
    """A pidfd of this process, for one that is started meanwhile with it in ``pass_fds``.

    Where there are none it is a pipe, of which the end comes with that of this process.
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
    """A fork would keep it open, and is told of its own by another."""
    while _pipe:
        os.close(_pipe.pop())


if not IS_LINUX:
    run_after_fork(_forget_pipe)


def program(module: str) -> list[str]:
    """The command that runs a module of ours: this very code, which need not be installed, as in a
    checkout. Neither the working directory nor a variable adds to what it may import.
    """
    packages = Path(__file__).parents[1], Path(protocol.__file__).parents[1]
    folders = sorted({str(package.parent) for package in packages})
    code = (
        f"import runpy, sys; sys.path[3:3] = {folders}; "  # behind the standard library
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-I", "-c", code]


def readable_within(fd: int, timeout_s: float) -> bool:
    """Whether there is something to read, or the other end has gone; waits for it."""
    if sys.platform == "win32":
        return bool(select.select([fd], [], [], timeout_s)[0])
    poll = select.poll()  # of descriptors beyond 1023, too
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(timeout_s * 1000))


def end_with(parent: int, patience_s: float) -> None:
    """End this process as soon as another has ended, and with it the group that it leads.
    ``parent``: a pidfd of the other.
    ``patience_s``: for what SIGTERM does here, in the main thread, before all are killed; with none
    they are killed at once.
    """
    os.set_inheritable(parent, False)
    threading.Thread(target=_watch, args=(parent, patience_s), daemon=True).start()


def _watch(parent: int, patience_s: float) -> None:
    if sys.platform != "win32":
        while not readable_within(parent, 3600.0):
            pass
        if patience_s > 0:
            # of all threads the one whose system call it has to interrupt
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            time.sleep(patience_s)
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGKILL)


def has_ended(pid: int) -> bool:
    """Whether a child has ended, reaped or not. It is a zombie before its threads are gone."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return True
    # the command may hold anything, parentheses and blanks included
    return stat.rpartition(")")[2].split()[0] in "ZX"


def occupy_streams() -> None:
    """Take the numbers 0, 1 and 2, where a program was started without them: ``<&- >&- 2>&-``.

    Else our first sockets and pipes would have them: what anybody prints would go to a worker, and
    what a worker is handed would be closed there in favour of its own standard streams.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) < _STREAMS:  # the lowest that is free
        os.set_inheritable(null, True)
    os.close(null)


def replace_missing_streams() -> None:
    """Occupy the numbers, and let ``print`` and others find a stream: for a program of ours."""
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
    """Why Windows has no file of this name, as the rest of a sentence; None if it can.
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
    """The same on Windows; None elsewhere."""
    return wrong_on_windows(path) if IS_WINDOWS else None


def taken_as_one(paths: Iterable[str]) -> tuple[str, str] | None:
    """Two of these, or of the folders above them, that a file system without case takes for one."""
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
    """Whether the file system of a folder takes two names that differ in case for one.

    Found out with a file of ours, for a platform has file systems of both kinds.
    Raises ``OSError``: the folder cannot be written.
    """
    probe = folder / f".envhub-case-{os.urandom(4).hex()}"
    os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    try:
        return os.path.lexists(probe.with_name(probe.name.upper()))
    finally:
        with contextlib.suppress(OSError):
            os.unlink(probe)

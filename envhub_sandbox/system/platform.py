"""What differs between Linux, macOS and Windows: the one place that asks which of them this is.

Jails need Linux. A client of a server on another host, or of a container, needs nothing of it, so
what Linux alone has is asked for here, with what stands in for it elsewhere.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

IS_LINUX: bool = sys.platform == "linux"
IS_WINDOWS: bool = sys.platform == "win32"
NAME: str = {"darwin": "macOS", "win32": "Windows"}.get(sys.platform, sys.platform)

_WINDOWS_VARIABLES = (
    *("SYSTEMROOT", "SYSTEMDRIVE", "COMSPEC", "PATHEXT", "TEMP", "TMP", "USERPROFILE", "APPDATA"),
    *("LOCALAPPDATA", "PROGRAMDATA", "PROGRAMFILES", "PROGRAMFILES(X86)", "PROGRAMW6432"),
)


def user_id() -> int:
    """The effective user's id; -1 on Windows, which has none."""
    found = -1
    if sys.platform != "win32":
        found = os.geteuid()
    return found


def cores() -> int:
    """How many processors this process may use."""
    found = os.cpu_count() or 1
    if sys.platform == "linux":
        found = len(os.sched_getaffinity(0))
    return found


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


def own_group() -> dict[str, Any]:
    """For ``subprocess.Popen``: a process to which a terminal sends no Ctrl-C."""
    how: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
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

"""Which process a thing was made for, in a form that outlives the process: for labels and files.

A pid alone is given out again. With its start time, the boot and the pid namespace it means one
process for ever, and whoever shares the namespace can tell whether that one still runs.
"""

from __future__ import annotations

import os
from pathlib import Path


def identity_of(pid: int) -> str:
    """``pid:start time:boot:pid namespace`` of a running process.

    Raises:
        OSError: There is no such process.
    """
    return f"{pid}:{_start_time(pid)}:{_boot()}:{_namespace()}"


def has_ended(identity: str) -> bool | None:
    """Whether the process has ended (reaped or not); None if that cannot be told from here."""
    parts = identity.split(":")
    if len(parts) != 4 or not parts[0].isdigit():
        return None
    pid, start_time, boot, namespace = parts
    if boot != _boot():
        return True
    if namespace != _namespace():
        return None
    try:
        return _state(int(pid)) in ("Z", "X") or _start_time(int(pid)) != start_time
    except FileNotFoundError:
        return True
    except OSError:
        return None


def is_of_this_boot(identity: str) -> bool:
    """Whether the process was one of this machine since it started."""
    parts = identity.split(":")
    return len(parts) == 4 and parts[2] == _boot()


def _start_time(pid: int) -> str:
    return _fields(pid)[19]


def _state(pid: int) -> str:
    return _fields(pid)[0]


def _fields(pid: int) -> list[str]:
    stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    # the command may hold anything, parentheses and blanks included
    return stat.rpartition(")")[2].split()


def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _namespace() -> str:
    return os.readlink("/proc/self/ns/pid").strip("pid:[]")

"""What ``/proc`` says of a process."""

from __future__ import annotations

from pathlib import Path


def has_ended(pid: int) -> bool:
    """Whether a child has ended, reaped or not. It is a zombie before its threads are gone."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return True
    # the command may hold anything, parentheses and blanks included
    return stat.rpartition(")")[2].split()[0] in "ZX"

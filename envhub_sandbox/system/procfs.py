"""What ``/proc`` says of a process."""

from __future__ import annotations

from pathlib import Path

_COMMAND_CHARS = 80


def command(pid: int) -> str:
    """The command line of a process, its first words; empty where that is not to be seen."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return ""
    return b" ".join(words).decode("utf-8", "replace").strip()[:_COMMAND_CHARS]


def has_ended(pid: int) -> bool:
    """Whether a child has ended, reaped or not. It is a zombie before its threads are gone."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return True
    # the command may hold anything, parentheses and blanks included
    return stat.rpartition(")")[2].split()[0] in "ZX"

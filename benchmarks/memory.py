"""Memory of our processes, with shared pages divided among those who share them."""

from __future__ import annotations

import gc
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import psutil

_PSS = re.compile(r"^Pss:\s+(\d+) kB", re.MULTILINE)


def descendants_mb() -> dict[str, float]:
    """Megabytes of the caller's descendants, by what they are, and their number.

    Raises:
        PermissionError: Some may not be read; root may read all.
    """
    found: dict[str, float] = {"processes": 0}
    for process in psutil.Process().children(recursive=True):
        kind = _kind(process)
        found[kind] = round(found.get(kind, 0.0) + _pss_mb(process.pid), 2)
        found["processes"] += 1
    found["total"] = round(sum(found.values()) - found["processes"], 2)
    return found


def growth_mb(work: Callable[[], object]) -> float:
    """Megabytes by which a fork of this process grows, and parts from it, when it does ``work``."""
    gc.collect()
    gc.freeze()
    ours, theirs = socket.socketpair()
    child = os.fork()
    if not child:
        try:
            theirs.send(b"forked")
            theirs.recv(1)
            kept = work()  # noqa: F841
            theirs.send(b"done")
            theirs.recv(1)
        finally:
            os._exit(0)
    sizes = []
    for _ in range(2):
        ours.recv(16)
        sizes.append(_pss_mb(os.getpid()) + _pss_mb(child))
        ours.send(b".")
    os.waitpid(child, 0)
    return round(sizes[1] - sizes[0], 2)


def _kind(process: psutil.Process) -> str:
    # forks of the zygote keep its command line: it is their parent, or nobody's fork
    words = process.cmdline()
    if "serve" in words:
        return "server"
    return "zygotes and workers" if "zygote" in words else "others"


def _pss_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    matched = _PSS.search(text)
    return int(matched.group(1)) / 1024 if matched else 0.0

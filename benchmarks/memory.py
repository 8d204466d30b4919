"""Memory of our processes, with shared pages divided among those who share them.

``python -m benchmarks.memory`` prints it for 1, 4, 16 and 64 CartPoles; root may read all of it.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import re
import socket
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import psutil

_CARTPOLE = str(Path(__file__).resolve().parents[1] / "examples" / "cartpole")
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


def by_size(sizes: Iterable[int] = (1, 4, 16, 64)) -> Iterator[tuple[int, dict[str, float]]]:
    """For each number of CartPoles, what they add to this process and its descendants, in MB."""
    # here, since probes that import this module measure what imports cost
    import gymnasium

    from envhub_sandbox import make_env

    makers: dict[str, Callable[[int], Any]] = {
        "SyncVectorEnv": lambda n: gymnasium.make_vec("CartPole-v1", n, "sync"),
        "AsyncVectorEnv": lambda n: gymnasium.make_vec("CartPole-v1", n, "async"),
        "envhub": lambda n: make_env(_CARTPOLE, n_envs=n).env,
        "envhub, async": lambda n: make_env(_CARTPOLE, n_envs=n, use_async_envs=True).env,
    }
    for size in sizes:
        yield size, {name: _added_mb(make, size) for name, make in makers.items()}


def _added_mb(make: Callable[[int], Any], size: int) -> float:
    """In a process of its own: what an earlier environment left is not counted."""
    ours, theirs = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=_measure, args=(make, size, theirs))
    child.start()
    added: float = ours.recv()
    child.join()
    return added


def _measure(make: Callable[[int], Any], size: int, told: Any) -> None:
    before = _pss_mb(os.getpid()) + descendants_mb()["total"]
    env = make(size)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    told.send(round(_pss_mb(os.getpid()) + descendants_mb()["total"] - before, 1))
    env.close()


if __name__ == "__main__":
    for number, row in by_size():
        print(number, row, flush=True)

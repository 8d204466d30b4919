"""How much memory 1, 4, 16 and 64 CartPoles take, with shared pages divided among their sharers.

``python -m benchmarks memory`` has no arguments; root may read all of it.
"""

from __future__ import annotations

import multiprocessing
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import psutil

from envhub_sandbox import make_env

_CARTPOLE = str(Path(__file__).resolve().parents[1] / "examples" / "cartpole")
_PSS = re.compile(r"^Pss:\s+(\d+) kB", re.MULTILINE)


def _total_mb() -> float:
    """Megabytes of this process and of all below it."""
    below = psutil.Process().children(recursive=True)
    return sum(_pss_mb(process.pid) for process in [psutil.Process(), *below])


def _pss_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    matched = _PSS.search(text)
    return int(matched.group(1)) / 1024 if matched else 0.0


def by_size(sizes: Iterable[int] = (1, 4, 16, 64)) -> Iterator[tuple[int, dict[str, float]]]:
    """For each number of CartPoles, what they add to this process and its descendants, in MB."""
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
    before = _total_mb()
    env = make(size)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    told.send(round(_total_mb() - before, 1))
    env.close()


if __name__ == "__main__":
    for number, row in by_size():
        print(number, row, flush=True)

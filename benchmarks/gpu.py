"""A real GPU in a jail, beside none: ``python -m benchmarks.gpu --help``.

Pendulums in batches of torch on the card, and HalfCheetah rendered through EGL: in this process and
in a jail with ``policy={"gpu": [0]}``, in alternating turns. What comes back must be equal, to the
bit. Then who gets the card's memory back after a close, a kill and a crash. Needs torch and
gymnasium[mujoco], and a GPU that both can use.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter, sleep
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.clock import Slice, run_slice
from benchmarks.machine import machine
from benchmarks.workloads import REPOSITORIES, module
from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError

_POLICY = {"gpu": [0]}
_EQUAL_STEPS = 20
_HELD_MIB = 4096
_FREED_S = 30.0


def main() -> None:
    """Print what came of each part."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=0.4, help="of each turn")
    options = parser.parse_args()
    facts = machine()
    print(f"{facts['processor']}, {facts['cores']} cores, kernel {facts['kernel']}; {_card()}\n")
    os.environ.setdefault("MUJOCO_GL", "egl")
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, {"ENVHUB_CACHE": cache}),
    ):
        os.chmod(cache, 0o755)  # jails of root run as another user
        print("| environment | n | us: this process | jail | jail / this process |", flush=True)
        print("|---|---|---|---|---|")
        for name, count in (("torch_batch", 1024), ("rendered", 1), ("rendered", 4)):
            print(_compared(name, count, options.rounds, options.seconds), flush=True)
        print("\nMiB of the card in use, before; while a jail holds 4,096; afterwards:")
        for title, end in (("close", _close), ("kill -9", _kill), ("crash", _crash)):
            print(f"- {title}: {_memory_after(end)}", flush=True)


def _compared(name: str, count: int, rounds: int, seconds: float) -> str:
    here = module(REPOSITORIES / name).make_env(count)
    with _in_jail(name, count) as there:
        _equal_steps(here, there)
        batches = itertools.cycle([here.action_space.sample() for _ in range(32)])
        ways: dict[str, Any] = {"here": here, "there": there}
        means: dict[str, list[float]] = {way: [] for way in ways}
        for turn in range(rounds):
            for way in ways if turn % 2 else reversed(ways):
                cost = run_slice(ways[way], Slice(seconds, 20), batches)
                means[way].append(float(cost["mean_ns"]) / 1e3)
    here.close()
    plain, jailed = (statistics.median(means[way]) for way in ways)
    ratio = statistics.median(b / a for a, b in zip(means["here"], means["there"], strict=True))
    return f"| {name} | {count} | {plain:.0f} | {jailed:.0f} | {ratio:.2f} |"


def _equal_steps(here: Any, there: Any) -> None:
    """Raise unless the first steps of both are equal, bit by bit."""
    here.action_space.seed(0)
    pairs = [(here.reset(seed=0)[0], there.reset(seed=0)[0])]
    for _ in range(_EQUAL_STEPS):
        actions = here.action_space.sample()
        pairs += zip(here.step(actions)[:4], there.step(actions)[:4], strict=True)
    for number, (one, other) in enumerate(pairs):
        if not np.array_equal(one, other):
            raise SystemExit(f"number {number} of what came back differs in the jail")


def _memory_after(end: Callable[[Any, set[int]], None]) -> str:
    before, others = _used_mib(), _users_of_the_card()
    with _in_jail("torch_batch", 4) as env:
        env.reset(seed=0)
        env.call("hold", _HELD_MIB)
        held = _used_mib()
        end(env, _users_of_the_card() - others)
        until = perf_counter() + _FREED_S
        while (after := _used_mib()) > before and perf_counter() < until:
            sleep(0.1)
    return f"{before}, {held}, {after}"


def _close(env: Any, pids: set[int]) -> None:
    env.close()


def _kill(env: Any, pids: set[int]) -> None:
    for pid in pids:
        os.kill(pid, signal.SIGKILL)


def _crash(env: Any, pids: set[int]) -> None:
    try:
        env.call("crash")
    except EnvHubError as error:
        print(f"  ({str(error).splitlines()[0]})")
    else:
        raise SystemExit("the jail did not end")


@contextmanager
def _in_jail(name: str, count: int) -> Iterator[Any]:
    with make_env(str(REPOSITORIES / name), count, policy=_POLICY) as suites:
        yield suites.env


def _card() -> str:
    return _asked("name,driver_version,memory.total")


def _used_mib() -> int:
    return int(_asked("memory.used").split()[0])


def _users_of_the_card() -> set[int]:
    """The processes that have its node open."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            opened = {os.readlink(link) for link in folder.iterdir()}
        except OSError:  # it has ended, or is not ours to see
            continue
        if "/dev/nvidia0" in opened:
            found.add(int(folder.parent.name))
    return found


def _asked(what: str) -> str:
    command = ["nvidia-smi", "-i", "0", f"--query-gpu={what}", "--format=csv,noheader"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()

"""What a fleet costs its driver: per step, per worker, per byte; and a model checked against it.

    python -m benchmarks.fleet [--rounds 15] [--steps 60] [--workers 1 2 4 8 16] [--bytes]

All workers are processes on this machine, so that nothing but the driver's part is told apart: its
own time on the processor, by the kernel's count, does not depend on how long it waits. Ways: shared
memory (``process``), frames without a network, and two servers on loopback with CURVE keys. Each
round steps every number of workers once, in a new order. Printed: the median of the rounds.

The model has two numbers of each way, found by least squares: ``fixed`` for a step and ``each`` for
each worker of it, both of the driver's processor time; and with ``--bytes`` a third, for each byte
of an observation. "predicted" is what the two say of the largest number of workers, from the
smaller ones alone.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter, process_time, thread_time
from typing import Any, NamedTuple

import numpy as np

from benchmarks import clients
from envhub_sandbox import make_env

_REPOSITORIES = Path(__file__).parent / "repositories"
_ROWS = 4
"""Sub-environments of each worker."""
_WARM_UP = 10
WAYS = ("shared memory", "frames", "CURVE")


class Cost(NamedTuple):
    """Of one step, in microseconds: until it was done, of the driver's thread, and of its process.

    The process has ZeroMQ's own thread besides, which encrypts.
    """

    elapsed: float
    thread: float
    process: float


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--bytes", action="store_true", help="also large observations")
    arguments = parser.parse_args(argv)
    with _places() as places:
        print("| way | workers | elapsed us | driver's thread us | of it each | with ZeroMQ us |")
        print("|---|---|---|---|---|---|")
        for way in arguments.ways:
            found = _costs(places[way], "cartpole", arguments)
            for workers, cost in found.items():
                words = [way, f"{workers}", f"{cost.elapsed:.0f}", f"{cost.thread:.0f}"]
                words += [f"{cost.thread / workers:.1f}", f"{cost.process:.0f}"]
                print("| " + " | ".join(words) + " |", flush=True)
            if len(found) > 2:
                print(f"| {way} | model | {_model(found)} | | | |", flush=True)
        if arguments.bytes:
            _print_bytes(places, arguments)
    return 0


def _model(found: dict[int, Cost]) -> str:
    """The two numbers, and whether they say what was measured of the most workers."""
    *fewer, most = sorted(found)
    fixed, each = fitted({workers: found[workers].thread for workers in fewer})
    predicted, measured = fixed + each * most, found[most].thread
    return (
        f"fixed {fixed:.0f} us, each {each:.1f} us; {most} workers: predicted {predicted:.0f}, "
        f"measured {measured:.0f}"
    )


def fitted(costs: dict[int, float]) -> tuple[float, float]:
    """``fixed`` and ``each`` of a line through costs by the number of workers."""
    each, fixed = np.polyfit(list(costs), list(costs.values()), 1)
    return float(fixed), float(each)


def _print_bytes(places: dict[str, dict[str, Any]], arguments: argparse.Namespace) -> None:
    """What a byte costs: two cameras of 1.8 MB in each observation, one row in each worker."""
    print("\n| way | bytes a step | elapsed us | driver us with ZeroMQ | MB/s of one driver |")
    print("|---|---|---|---|---|")
    few = argparse.Namespace(**vars(arguments) | {"workers": [1, 2, 4], "steps": 8})
    for way in arguments.ways:
        for workers, cost in _costs(places[way], "cameras", few, rows=1).items():
            size = workers * 2 * 480 * 640 * 3
            rate = size / cost.process
            print(
                f"| {way} | {size} | {cost.elapsed:.0f} | {cost.process:.0f} | {rate:.0f} |",
                flush=True,
            )


def _costs(
    place: dict[str, Any], name: str, arguments: argparse.Namespace, rows: int = _ROWS
) -> dict[int, Cost]:
    """The median cost of a step, by the number of workers."""
    with contextlib.ExitStack() as stack:
        envs: dict[int, Any] = {}
        for workers in arguments.workers:
            suites = make_env(
                _REPOSITORIES / name, n_envs=rows * workers, num_workers=workers, **place
            )
            envs[workers] = stack.enter_context(suites).env
            envs[workers].reset(seed=0)
        found: dict[int, list[Cost]] = {workers: [] for workers in envs}
        for _ in range(arguments.rounds):
            order = list(envs)
            random.shuffle(order)
            for workers in order:
                found[workers].append(_cost(envs[workers], arguments.steps))
    return {
        workers: Cost(*np.median(np.array(costs), axis=0).tolist())
        for workers, costs in found.items()
    }


def _cost(env: Any, steps: int) -> Cost:
    actions = env.action_space.sample()
    for _ in range(_WARM_UP):
        env.step(actions)
    clocks = (perf_counter, thread_time, process_time)
    before = [clock() for clock in clocks]
    for _ in range(steps):
        env.step(actions)
    spent = [clock() - start for clock, start in zip(clocks, before, strict=True)]
    return Cost(*(1e6 * one / steps for one in spent))


@contextlib.contextmanager
def _places() -> Iterator[dict[str, dict[str, Any]]]:
    """By the name of the way, what ``make_env`` is given."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        servers = []
        for number in range(2):
            Path(folder, f"{number}").mkdir()
            server = clients.Server(Path(folder, f"{number}"))
            servers.append(stack.enter_context(server).sandbox())
        here = ["process", "process"]
        yield {
            "shared memory": {"sandbox": here},
            "frames": {"sandbox": here, "lane": "frames"},
            "CURVE": {"sandbox": servers},
        }


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())

"""Evaluations of suites, and first steps: ``python -m benchmarks.suites --help``.

What LeRobot's ``eval_policy_all`` does to a suite of tasks, one after the other, each closed
before the next opens (``tests/support/lerobot.py`` follows it call by call): over in-process
vector environments that are built when they are first used, as LeRobot builds its own, and over
this project's, for a pin whose manifest is known. Every run is an interpreter of its own, and the
variants take turns, so that ratios are of one time on one machine. Needs torch, and root for the
number of processes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import which
from time import perf_counter
from typing import Any

from benchmarks.driver import ROOT
from benchmarks.watching import Watched, watch
from benchmarks.workloads import REPOSITORIES

VARIANTS = ("lerobot-sync", "lerobot-async", "envhub-sync", "envhub-async")
N_ENVS = 4
_MODULE_BYTES = 2_000_000
_FIRST_ROUNDS = 7


def play(variant: str, folder: str, tasks: int, heavy: bool) -> None:
    """One evaluation in this process; prints a line before it and a JSON object after it."""
    import torch

    from tests.support import lerobot

    torch.manual_seed(0)
    policy = torch.nn.Linear(4, 2)
    make = _ours if variant.startswith("envhub") else _theirs
    make(variant.endswith("async"), folder, 1, heavy=False, only_import=True)
    print("imported", flush=True)
    start = perf_counter()
    envs, end = make(variant.endswith("async"), folder, tasks, heavy=heavy)
    found = lerobot.evaluate_all(
        envs, lambda seen: policy(seen["observation.state"]), N_ENVS, 1, render=False
    )
    end()
    seconds = perf_counter() - start
    print(json.dumps({"seconds": seconds, "returns": [one["returns"] for one in found.values()]}))


def _ours(
    use_async: bool, folder: str, tasks: int, *, heavy: bool, only_import: bool = False
) -> Any:
    from envhub_sandbox import make_env

    if only_import:
        return None
    given = {"tasks": tasks, "heavy": heavy}
    suites = make_env(folder, N_ENVS, use_async, env_kwargs=given, timeouts={"startup_s": 300})
    return suites, suites.close


def _theirs(
    use_async: bool, folder: str, tasks: int, *, heavy: bool, only_import: bool = False
) -> Any:
    import gymnasium as gym

    if only_import:
        return None
    sys.path.insert(0, folder)
    import env as repository

    def build(task: int) -> Callable[[], Any]:
        kind = gym.vector.AsyncVectorEnv if use_async else gym.vector.SyncVectorEnv
        makers = [
            lambda index=index: repository.Reach(task, heavy and index == 0)
            for index in range(N_ENVS)
        ]
        return lambda: kind(makers)

    return {"reach": {task: _Lazy(build(task)) for task in range(tasks)}}, lambda: None


class _Lazy:
    """A vector environment that is built when it is first looked into, as LeRobot's are."""

    def __init__(self, build: Callable[[], Any]) -> None:
        self._build = build
        self._env: Any = None

    def _ensure(self) -> None:
        if self._env is None:
            self._env = self._build()

    def __getattr__(self, name: str) -> Any:
        self._ensure()
        return getattr(self._env, name)

    @property
    def unwrapped(self) -> Any:
        """The vector environment itself."""
        self._ensure()
        return self._env

    def close(self) -> None:
        """Close what was built, and forget it."""
        if self._env is not None:
            self._env.close()
        self._env = None


def evaluate(variant: str, folder: str, tasks: int, heavy: bool, *, memory: bool) -> Watched:
    """The same in an interpreter of its own."""
    command = [sys.executable, "-m", "benchmarks.suites", "--play", variant, "--folder", folder]
    command += ["--tasks", str(tasks), *(["--heavy"] if heavy else [])]
    return watch(command, memory=memory)


def compare(folder: str, tasks: int, heavy: bool, rounds: int, variants: list[str]) -> list[Any]:
    """One row for each variant: medians of rounds in turns, and a run of its own for memory."""
    for variant in variants:
        evaluate(variant, folder, tasks, heavy, memory=False)  # from here on the pin is known
    runs: dict[str, list[Watched]] = {variant: [] for variant in variants}
    for _ in range(rounds):
        for variant in variants:
            runs[variant].append(evaluate(variant, folder, tasks, heavy, memory=False))
    rows = []
    for variant in variants:
        watched = evaluate(variant, folder, tasks, heavy, memory=True)
        found = [json.loads(run.output) for run in runs[variant]]
        rows.append(
            {
                "variant": variant,
                "seconds": round(statistics.median(one["seconds"] for one in found), 2),
                "all": [round(one["seconds"], 2) for one in found],
                "peak_mb": watched.peak_mb,
                "ever": runs[variant][-1].ever,
                "peak_processes": runs[variant][-1].peak_processes,
                "stolen": max(run.stolen for run in runs[variant]),
                "load": round(max(run.load for run in runs[variant]), 1),
                "returns": found[0]["returns"],
            }
        )
    return rows


FIRST = """
import sys, time
start = time.perf_counter()
from envhub_sandbox import make_env
imported = time.perf_counter()
{prepare}
begin = time.perf_counter()
{measured}
print((time.perf_counter() - begin) * 1000)
suites.close()
"""
_MAKE = f"suites = make_env({str(REPOSITORIES / 'cartpole')!r}, 4)"
_RESET = "suites.env.reset(seed=0)"
FIRSTS = {
    "first reset, known pin, warm server": (
        f"other = {_MAKE[9:]}; other.env.reset(seed=0); {_MAKE}",
        _RESET,
    ),
    "first reset, known pin, no server": (_MAKE, _RESET),
    "cold make_env and first reset": ("", f"{_MAKE}; {_RESET}"),
}
COMMANDS = {
    'python -c "import numpy, gymnasium"': [sys.executable, "-c", "import numpy, gymnasium"],
    "python -c pass": [sys.executable, "-c", "pass"],
    "import envhub_sandbox": [sys.executable, "-c", "import envhub_sandbox"],
    "import make_env": [sys.executable, "-c", "from envhub_sandbox import make_env"],
    "envhub --help": [which("envhub", path=os.path.dirname(sys.executable)) or "envhub", "--help"],
    "hf --help": [which("hf", path=os.path.dirname(sys.executable)) or "hf", "--help"],
}


def first_steps(rounds: int) -> dict[str, list[float]]:
    """Milliseconds, everything in turns."""
    found: dict[str, list[float]] = {name: [] for name in (*COMMANDS, *FIRSTS)}
    with tempfile.TemporaryDirectory() as known:
        for _ in range(rounds + 1):
            for name, command in COMMANDS.items():
                start = perf_counter()
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                found[name].append((perf_counter() - start) * 1000)
            for name, (prepare, measured) in FIRSTS.items():
                with tempfile.TemporaryDirectory() as fresh:
                    cache = fresh if name.startswith("cold") else known
                    found[name].append(_first(prepare, measured, cache))
    return {name: costs[1:] for name, costs in found.items()}


def _first(prepare: str, measured: str, cache: str) -> float:
    program = FIRST.format(prepare=prepare, measured=measured)
    variables = os.environ | {"ENVHUB_CACHE": cache}
    command = [sys.executable, "-c", program]
    return float(subprocess.run(command, env=variables, check=True, stdout=-1, text=True).stdout)


def _tables(options: argparse.Namespace, folder: str) -> Iterator[str]:
    before = os.environ.get("ENVHUB_CACHE")
    with tempfile.TemporaryDirectory() as cache:
        os.environ["ENVHUB_CACHE"] = cache
        if "light" in options.parts:
            yield from _rows(compare(folder, 10, False, options.rounds, options.variants))
        if "heavy" in options.parts:
            yield from _rows(
                compare(folder, 10, True, max(options.rounds // 2, 1), options.variants)
            )
        if "growth" in options.parts:
            for variant in options.variants:
                sizes = [evaluate(variant, folder, n, False, memory=True) for n in (10, 10, 40)]
                yield f"{variant}: 10 tasks {sizes[1].peak_mb} MB, 40 tasks {sizes[2].peak_mb} MB"
    os.environ.pop("ENVHUB_CACHE")
    if before is not None:
        os.environ["ENVHUB_CACHE"] = before
    if "first" in options.parts:
        found = first_steps(options.rounds)
        base = statistics.median(found['python -c "import numpy, gymnasium"'])
        for name, costs in found.items():
            median, least = statistics.median(costs), min(costs)
            yield f"| {name} | {median:.0f} ms | {least:.0f} ms | {median / base:.2f} |"


def _rows(rows: list[dict[str, Any]]) -> Iterator[str]:
    if any(row["returns"] != rows[0]["returns"] for row in rows):
        yield "the variants' returns differ"
    for row in rows:
        yield (
            f"| {row['variant']} | {row['seconds']} s | {row['peak_mb']} MB | {row['ever']} | "
            f"{row['peak_processes']} | {100 * row['stolen']:.1f} % | {row['load']} | "
            f"{row['all']} |"
        )


def main() -> None:
    """Play, or compare."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.suites", description=__doc__)
    parser.add_argument("parts", nargs="*", default=["light", "heavy", "growth", "first"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--play", choices=VARIANTS, help="one evaluation, in this process")
    parser.add_argument("--folder")
    parser.add_argument("--tasks", type=int, default=10)
    parser.add_argument("--heavy", action="store_true")
    options = parser.parse_args()
    if options.play:
        play(options.play, options.folder, options.tasks, options.heavy)
        return
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "suite"
        folder.mkdir()
        (folder / "env.py").write_text((REPOSITORIES / "suite" / "env.py").read_text())
        (folder / "simulator.py").write_text(_simulator())
        os.chmod(parent, 0o755)
        for line in _tables(options, str(folder)):
            print(line, flush=True)


def _simulator() -> str:
    """A module as large as a simulator's Python."""
    lines, size = [], 0
    while size < _MODULE_BYTES:
        lines.append(f"def function_{len(lines)}(a, b=1):\n    return a * {len(lines)} + b\n")
        size += len(lines[-1])
    return "".join(lines)


if __name__ == "__main__":
    main()

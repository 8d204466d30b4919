"""How long evaluations of whole suites take as LeRobot does them, and first steps.

What is evaluated, and by what, is said in ``evaluations.py``. Every run is an interpreter of its
own, and the variants take turns, so that ratios are of one time on one machine. Needs torch, or
with ``--lerobot`` an interpreter with LeRobot.
"""

from __future__ import annotations

import argparse
import json
import os
import py_compile
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import which
from time import perf_counter
from typing import Any
from unittest.mock import patch

from benchmarks.driver import ROOT
from benchmarks.evaluations import LAZY, LEROBOT, LOOP, VARIANTS
from benchmarks.interpreters import PEER_VENVS
from benchmarks.workloads import REPOSITORIES

HEAVY_TASKS = 6
_MODULE_BYTES = 2_000_000


@dataclass(frozen=True)
class Suite:
    """What is evaluated in every run.

    Attributes:
        folder: The repository.
        tasks: How many it has.
        heavy: Where the simulator lies that each of them is; empty if none is.
        python: The interpreter.
        evaluator: Its module that evaluates.
    """

    folder: str
    python: str
    evaluator: str
    tasks: int = 10
    heavy: str = ""

    def evaluate(self, variant: str) -> dict[str, Any]:
        """Once, in an interpreter of its own; what it found, and its processor time as ``cpu``."""
        command = [self.python, "-m", "benchmarks.evaluations", variant, self.folder]
        command += ["--tasks", str(self.tasks), "--evaluator", self.evaluator]
        command += ["--heavy", self.heavy] if self.heavy else []
        path = os.pathsep.join([str(ROOT), str(ROOT / "worker")])
        variables = {**os.environ, "PYTHONPATH": path}
        before = _cpu_s()
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=variables)
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return {**found, "cpu": _cpu_s() - before - found["imports_cpu_s"]}


def _cpu_s() -> float:
    """Of all that this process has waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def compare(suite: Suite, rounds: int, variants: Sequence[str]) -> list[dict[str, Any]]:
    """One row for each variant: medians of rounds in turns."""
    for variant in variants:
        suite.evaluate(variant)  # from here on the pin is known
    runs: dict[str, list[dict[str, Any]]] = {variant: [] for variant in variants}
    for _ in range(rounds):
        for variant in variants:
            runs[variant].append(suite.evaluate(variant))
    rows = [_row(variant, runs[variant]) for variant in variants]
    if any(row["returns"] != rows[0]["returns"] for row in rows):
        raise RuntimeError("the variants' returns differ")
    return rows


def _row(variant: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "variant": variant,
        "seconds": statistics.median(run["seconds"] for run in runs),
        "cpu": statistics.median(run["cpu"] for run in runs),
        "all": [round(run["seconds"], 2) for run in runs],
        "returns": runs[0]["returns"],
    }


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


def _tables(options: argparse.Namespace, suite: Suite) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as cache, patch.dict(os.environ, {"ENVHUB_CACHE": cache}):
        for part in ("light", "heavy"):
            if part in options.parts:
                rounds = options.rounds if part == "light" else max(options.rounds // 2, 1)
                chosen = suite
                if part == "heavy":
                    chosen = replace(suite, heavy=options.simulator, tasks=HEAVY_TASKS)
                yield f"{part}: {chosen.tasks} tasks"
                yield from _rows(compare(chosen, rounds, options.variants))
    if "first" in options.parts:
        found = first_steps(options.rounds)
        base = statistics.median(found['python -c "import numpy, gymnasium"'])
        for name, costs in found.items():
            median, least = statistics.median(costs), min(costs)
            yield f"| {name} | {median:.0f} ms | {least:.0f} ms | {median / base:.2f} |"


def _rows(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| variant | seconds | processor | all |"
    for row in rows:
        yield f"| {row['variant']} | {row['seconds']:.2f} s | {row['cpu']:.2f} s | {row['all']} |"


def main() -> None:
    """Compare."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks suites", description=__doc__)
    parser.add_argument("parts", nargs="*", default=["light", "heavy", "first"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tasks", type=int, default=10)
    parser.add_argument("--variants", nargs="+", choices=(*VARIANTS, LAZY))
    parser.add_argument(
        "--lerobot",
        nargs="?",
        const=str(PEER_VENVS / "lerobot" / "bin" / "python"),
        metavar="PYTHON",
        help="evaluate with LeRobot's own code, in an interpreter that has it",
    )
    options = parser.parse_args()
    if options.lerobot and not Path(options.lerobot).exists():
        parser.error(f"there is no {options.lerobot}; first: python -m benchmarks venvs lerobot")
    evaluator = LEROBOT if options.lerobot else LOOP
    options.variants = options.variants or VARIANTS
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "suite"
        folder.mkdir()
        (folder / "env.py").write_text((REPOSITORIES / "suite" / "env.py").read_text())
        options.simulator = _install_simulator(Path(parent) / "packages")
        os.chmod(parent, 0o755)
        python = options.lerobot or sys.executable
        suite = Suite(str(folder), python, evaluator, options.tasks)
        for line in _tables(options, suite):
            print(line, flush=True)


def _install_simulator(packages: Path) -> str:
    """Where it is, with its byte code, as what is installed has."""
    packages.mkdir()
    (packages / "simulator.py").write_text(_simulator())
    py_compile.compile(str(packages / "simulator.py"), doraise=True)
    return str(packages)


def _simulator() -> str:
    """A module as large as a simulator's Python."""
    lines, size = [], 0
    while size < _MODULE_BYTES:
        lines.append(f"def function_{len(lines)}(a, b=1):\n    return a * {len(lines)} + b\n")
        size += len(lines[-1])
    return "".join(lines)


if __name__ == "__main__":
    main()

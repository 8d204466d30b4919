"""Each benchmark is started once, as short as can be: it runs, and says nothing about speed.

``soak``, ``monkey`` and ``clients`` have short forms in ``tests/faults``, ``packages`` is a step of
CI, ``containers`` needs an engine, and ``evaluations`` is what ``suites`` starts.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.support.command_line import python

pytestmark = pytest.mark.same_for("users")

SHORT = {
    "breakdown cartpole 1": "| 1 | 1 | chosen |",
    "doorbells --rounds 1 --trips 20": "of eventfds",
    "recording --rounds 1 --count 5": "| its own |",
    "remote 0.01 plain": "| plain, n=1 |",
    "remote driver 0.01": "| 16 |",
    "suites first --rounds 1 --tasks 2": "| cold make_env and first reset |",
}


def benchmark(checkout: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    return python("-m", *words, cwd=checkout, code=code, PYTHONDONTWRITEBYTECODE="1")


@pytest.mark.parametrize("words", SHORT)
def test_a_benchmark_runs(words: str, checkout: Path) -> None:
    done = benchmark(checkout, *f"benchmarks.{words}".split())
    assert SHORT[words] in done.stdout


def test_the_comparison_runs(checkout: Path, tmp_path: Path) -> None:
    benchmark(checkout, "benchmarks", "--quick", "--out", str(tmp_path))
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".md"}


def test_a_benchmark_that_lacks_its_environment_says_how_to_make_it(checkout: Path) -> None:
    done = benchmark(checkout, "benchmarks.suites", "--lerobot", "/none/bin/python", code=2)
    assert "first: python -m benchmarks.venvs lerobot" in done.stderr

"""Each benchmark is started once, as short as can be: it runs, and says nothing about speed.
``reach`` is a step of CI; ``suites`` imports torch in each of its interpreters, and ``remote``
takes longer than what it shows: they are left out."""

import re
import subprocess
from pathlib import Path

import pytest

from tests.support.command_line import python

SHORT = "auto --workloads cartpole --sizes 2 --rounds 1 --seconds 0.01 --busy 1"


def benchmark(checkout: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    return python("-m", *words, cwd=checkout, code=code, PYTHONDONTWRITEBYTECODE="1")


def test_a_benchmark_runs(checkout: Path) -> None:
    assert "| CartPole | 2 |" in benchmark(checkout, "benchmarks", *SHORT.split()).stdout


def test_growth_is_measured_and_drawn(checkout: Path, tmp_path: Path) -> None:
    plot = tmp_path / "growth.svg"
    words = f"growth --sizes 1 2 --bytes 9 --processes 1 --rounds 1 --seconds 0.01 --plot {plot}"
    told = benchmark(checkout, "benchmarks", *words.split()).stdout
    assert re.findall(r"^\| (\d+) \|", told, re.MULTILINE) == ["1", "2", "9", "1"]
    assert plot.read_text().count("<polyline") == 4 + 4 + 3


def test_the_comparison_runs(checkout: Path, tmp_path: Path) -> None:
    words = ("--peers", "sync", "envhub", "--out", str(tmp_path))
    benchmark(checkout, "benchmarks", "steps", "--quick", *words)
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".md"}


def test_a_benchmark_that_lacks_its_environment_says_how_to_make_it(checkout: Path) -> None:
    done = benchmark(checkout, "benchmarks", "suites", "--lerobot", "/none/bin/python", code=2)
    assert "first: python -m benchmarks venvs lerobot" in done.stderr


def test_the_benchmarks_are_listed_with_a_sentence_each(checkout: Path) -> None:
    _, _, *lines = benchmark(checkout, "benchmarks").stdout.splitlines()
    words = {line.split()[0]: line.split(maxsplit=1)[1] for line in lines}
    assert {"auto", "growth", "remote", "steps", "suites", "reach", "memory"} <= {*words}
    assert all(text.endswith(".") for text in words.values())


@pytest.mark.parametrize("name", ["memory", "remote", "venvs"])
def test_a_benchmark_describes_itself_instead_of_running(checkout: Path, name: str) -> None:
    """Also those that read no options."""
    told = benchmark(checkout, "benchmarks", name, "--help").stdout
    assert f"python -m benchmarks {name}" in told

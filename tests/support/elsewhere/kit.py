"""Starts programs of ours as if on macOS or on Windows."""

import os
import subprocess
import sys
from pathlib import Path

SYSTEMS = ("darwin", "win32")
INTERPRETER = Path(__file__).with_name("interpreter.py")


def command(system: str, *words: str | Path) -> list[str]:
    """What starts Python there: ``-c CODE`` or ``-m MODULE``, and arguments. Compiles nothing."""
    return [sys.executable, "-I", "-B", str(INTERPRETER), system, *map(str, words)]


def ran(
    system: str, *words: str | Path, code: int | None = 0, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run Python there to its end, with this exit code unless that is None."""
    done = subprocess.run(
        command(system, *words),
        capture_output=True,
        text=True,
        encoding="utf-8",
        env={**os.environ, "PYTHONIOENCODING": "utf-8", **variables},
        timeout=600,
        check=False,
    )
    assert code is None or done.returncode == code, done.stdout[-4000:] + done.stderr[-4000:]
    return done


def elsewhere(system: str, program: str, *arguments: str | Path, **variables: str) -> str:
    return ran(system, "-c", program, *arguments, **variables).stdout

"""The command line ``envhub``, here or in a process of its own, and the processes below it."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from typer.testing import CliRunner

from envhub_sandbox.cli.app import app

COMMAND = [sys.executable, "-I", "-m", "envhub_sandbox"]


def python(
    *arguments: str | Path, cwd: Path | None = None, code: int | None = 0, **variables: str
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, **variables},
        timeout=600,
        check=False,
    )
    assert code is None or done.returncode == code, done.stdout[-4000:] + done.stderr[-4000:]
    return done


def envhub(
    *arguments: str | Path, code: int | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end, in this process, whose worker servers it uses."""
    done = CliRunner().invoke(app, [*map(str, arguments)], env=variables, prog_name="envhub")
    assert code is None or done.exit_code == code, done.output
    return subprocess.CompletedProcess(arguments, done.exit_code, done.stdout, done.stderr)


def program(
    *arguments: str | Path, code: int | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    """The same in a process of its own, where its streams and what it imports matter."""
    variables = {"PYTHONIOENCODING": "utf-8", **variables}
    return python(*COMMAND[1:], *arguments, code=code, **variables)


def document(*arguments: str | Path, code: int = 0) -> dict[str, Any]:
    """The document of ``--json``, which is all that is on stdout."""
    return json.loads(envhub(*arguments, "--json", code=code).stdout, parse_constant=pytest.fail)


def below(pid: int) -> list[psutil.Process]:
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).children(recursive=True)
    return []


def gone(processes: list[psutil.Process]) -> bool:
    """Whether none of them is still running."""
    return not any(map(runs, processes))


def runs(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    return False

"""A program that was started without standard streams has environments as any other."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.remote.listening import WORKER
from tests.support.processes import eventually
from tests.support.samples import sample

_PROGRAM = """
import json, os, sys, traceback
told = {"missing": [name for name in ("stdin", "stdout", "stderr") if getattr(sys, name) is None]}
try:
    from envhub_sandbox import make_env
    with make_env(sys.argv[1], n_envs=2) as suites:
        suites.env.reset(seed=1)
        for _ in range(3):
            os.write(1, b"what C code prints") and os.write(2, b"and warns of")
            observation = suites.env.step(suites.env.action_space.sample())[0]
    told["shape"] = observation.shape
except BaseException:
    told["error"] = traceback.format_exc()
with open(sys.argv[2], "w") as file:
    json.dump(told, file)
"""
CLOSED = {"<&- >&- 2>&-": ["stdin", "stdout", "stderr"]}


def without(streams: str, *command: object) -> int:
    """The exit code of a command that a shell starts so."""
    words = ["sh", "-c", f'exec "$@" {streams}', "sh", *map(str, command)]
    return subprocess.run(words, timeout=300, check=False).returncode


@pytest.mark.parametrize("streams", CLOSED)
def test_an_environment_runs_and_nobody_prints_into_it(tmp_path: Path, streams: str) -> None:
    said = tmp_path / "said"
    without(streams, sys.executable, "-c", _PROGRAM, sample("counter"), said)
    told = json.loads(said.read_text())
    assert told["missing"] == CLOSED[streams]
    assert "error" not in told, told["error"]
    assert told["shape"] == [2, 3]


def test_a_command_runs() -> None:
    command = [sys.executable, "-I", "-m", "envhub_sandbox", "inspect", sample("counter")]
    assert without("2>&-", *command) == 0


def test_a_server_has_nothing_of_its_own_there(tmp_path: Path) -> None:
    """What a library prints into it would otherwise go into a lock, or wake its loop."""
    state = tmp_path / "state"
    command = [*WORKER, "listen", "--bind", "tcp://127.0.0.1:*", "--state-dir", str(state)]
    words = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command]
    with subprocess.Popen(words) as server:
        try:
            assert eventually(lambda: noted(state) or server.poll() is not None)
            assert server.poll() is None
            assert [os.readlink(f"/proc/{server.pid}/fd/{number}") for number in range(3)] == [
                os.devnull
            ] * 3
        finally:
            server.terminate()


def noted(state: Path) -> bool:
    """Whether a server says on its machine where it listens."""
    note = state / "endpoint"
    return note.exists() and bool(note.read_text())

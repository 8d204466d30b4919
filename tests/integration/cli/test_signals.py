"""Ctrl-C, termination, closed pipes and terminals."""

import contextlib
import os
import pty
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.support.command_line import COMMAND, below, gone
from tests.support.processes import eventually
from tests.support.repositories import STILL
from tests.support.samples import EXAMPLES, sample

_STEPPING = f"""{STILL}
import time

class Endless(Still):
    def step(self, action):
        time.sleep(%s)
        return super().step(action)
"""


@pytest.mark.parametrize(
    ("number", "code", "says", "step_s"),
    [(signal.SIGINT, 130, "Interrupted.\n", 3600), (signal.SIGTERM, 143, "", 0.001)],
    ids=["stuck in a step", "stepping"],
)
def test_an_interrupted_run_ends_and_leaves_nothing(
    tmp_path: Path, number: signal.Signals, code: int, says: str, step_s: float
) -> None:
    """With its code, no traceback, and every process of the environment gone."""
    (tmp_path / "env.py").write_text(_STEPPING % step_s)
    with (
        # a short name: socket paths have 108 bytes
        tempfile.TemporaryDirectory(prefix="e", dir="/tmp") as folder,
        subprocess.Popen(
            [*COMMAND, "run", str(tmp_path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": folder},
        ) as process,
    ):
        # the worker server, its zygote, and a jail below it
        assert eventually(lambda: len(below(process.pid)) >= 3, 120)
        processes = below(process.pid)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
        seen = f"local folder {tmp_path}: the code sees 1 file of it\n"
        assert (process.returncode, out, err) == (code, "", seen + says)
        assert eventually(lambda: gone(processes))
        assert eventually(lambda: not os.listdir(folder))


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", str(EXAMPLES / "cartpole"), "--episodes", "1"),
        ("cache", "list", "--json"),
        ("--version",),
    ],
)
def test_a_closed_pipe_is_no_traceback(arguments: tuple[str, ...]) -> None:
    """``envhub ... | head`` ends quietly, with the code that programs in C would have."""
    read, write = os.pipe()
    os.close(read)
    try:
        done = subprocess.run(
            [*COMMAND, *arguments], stdout=write, stderr=subprocess.PIPE, timeout=240, check=False
        )
    finally:
        os.close(write)
    lines = [line for line in done.stderr.splitlines() if b"the code sees" not in line]
    assert (done.returncode, lines) == (141, [])


def test_a_terminal_sees_progress_and_a_pipe_gets_the_results() -> None:
    """The bar goes to stderr, is taken away in the end, and the cursor comes back."""
    controller, terminal = pty.openpty()
    arguments = ["run", str(sample("many_tasks")), "--episodes", "1", "--steps", "5"]
    with subprocess.Popen(
        [*COMMAND, *arguments, "--task", "0"],
        stdout=subprocess.PIPE,
        stderr=terminal,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    ) as process:
        os.close(terminal)
        seen = b""
        with contextlib.suppress(OSError):  # EIO: the other end is closed
            while chunk := os.read(controller, 65536):
                seen += chunk
        out = process.stdout.read()
    os.close(controller)
    assert process.returncode == 0
    assert b"loading" in seen
    assert seen.rfind(b"\x1b[?25h") > seen.rfind(b"\x1b[?25l")
    assert b"\x1b" not in out
    assert b"steps/s" in out


def test_ctrl_c_ends_a_download_that_hangs(hub_cache: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"http://127.0.0.1:{silent.getsockname()[1]}"
        arguments = ["run", "org/repo", "--endpoint", endpoint, "--hub-cache-dir", str(hub_cache)]
        with subprocess.Popen(
            [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            silent.settimeout(60)
            connection, _ = silent.accept()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
            connection.close()
    assert (process.returncode, out, err) == (130, "", "Interrupted.\n")

"""How a worker server has ended is told, with what to do; and it stays to be reaped."""

from __future__ import annotations

import os
import select
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from envhub_sandbox.transport.connection import describe_exit


@contextmanager
def process(script: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """One that has ended, and a pidfd of it."""
    with subprocess.Popen(["sh", "-c", script]) as child:
        pidfd = os.pidfd_open(child.pid)
        try:
            assert select.select([pidfd], [], [], 120)[0]
            yield child, pidfd
        finally:
            os.close(pidfd)


@pytest.mark.parametrize(
    ("script", "says", "code"),
    [
        ("kill -KILL $$", " by SIGKILL, by another process or by the kernel", -9),
        ("kill -TERM $$", " by SIGTERM. The next", -15),
        ("exit 3", ", with exit code 3. The next", 3),
        ("exit 137", " with its container, by SIGKILL, by another process or by the kernel", 137),
        ("exit 143", " with its container, by SIGTERM. The next", 143),
    ],
)
def test_its_end_is_told(script: str, says: str, code: int) -> None:
    """By itself, or as an engine tells of its container's program."""
    with process(script) as (child, pidfd):
        told = describe_exit(pidfd)
        assert told.startswith(says)
        assert told.endswith("starts another")
        assert ("DockerSandbox(memory=" in told) == (code == 137)
        assert child.wait() == code


def test_what_another_has_reaped_ended_somehow() -> None:
    """As far as we know; what lives has not."""
    with process("exit 3") as (child, pidfd):
        child.wait()
        assert describe_exit(pidfd).startswith(". The next")
    living = os.pidfd_open(os.getpid())
    try:
        assert describe_exit(living).startswith(". The next")
    finally:
        os.close(living)

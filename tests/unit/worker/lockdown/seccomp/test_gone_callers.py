"""Signals of a jail that init sends: whose caller may go at any moment."""

from __future__ import annotations

import errno
import subprocess
import sys

import pytest

from envhub_worker.lockdown.seccomp import notify
from envhub_worker.lockdown.seccomp.syscalls import number


@pytest.mark.parametrize("to", ["its group", "init"])
def test_a_caller_that_has_gone_since_ends_nobody(to: str) -> None:
    """It was killed between its call and our look at its group: the answer reaches nobody."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    target = -gone.pid if to == "its group" else 1
    asked = notify.Request(gone.pid, gone.pid, number("kill"), (target, 15, 0))
    assert notify.decide(asked, list) == notify.Answer(errno.ESRCH)

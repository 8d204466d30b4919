"""The exit status of a worker server's process, in words, for an error."""

from __future__ import annotations

import contextlib
import os
import signal

from envhub_sandbox.options import option_name

_KILLED_IN_A_CONTAINER = 128
"""And the signal's number: an engine's exit code, where the container's program got one."""


def describe_exit(process_fd: int) -> str:
    """How it ended and what to do, as the rest of a sentence. The process stays to be reaped.

    Args:
        process_fd: A pidfd of it, or of the monitor of its container.
    """
    status = None
    with contextlib.suppress(OSError):  # it was reaped already, or it is no process
        status = os.waitid(os.P_PIDFD, process_fd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    if status is None:
        return f". {_next()}"
    if status.si_code in (os.CLD_KILLED, os.CLD_DUMPED):
        return f" by {_named(status.si_status)}{_culprit(status.si_status)}. {_next()}"
    number = status.si_status - _KILLED_IN_A_CONTAINER
    if number in signal.valid_signals():
        where = "; the container's own limit is DockerSandbox(memory=...) in Python"
        why = _culprit(number) + (where if number == signal.SIGKILL else "")
        return f" with its container, by {_named(number)}{why}. {_next()}"
    return f", with exit code {status.si_status}. {_next()}"


def _next() -> str:
    fresh = option_name("restart", "on_reset")
    return f"The next make_env, or with {fresh} the next reset(), starts another"


def _named(number: int) -> str:
    with contextlib.suppress(ValueError):
        return signal.Signals(number).name
    return f"signal {number}"


def _culprit(number: int) -> str:
    if number != signal.SIGKILL:
        return ""
    return ", by another process or by the kernel, as where memory runs out (dmesg says so)"

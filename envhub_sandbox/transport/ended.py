"""How the process of a worker server has ended, for the error of whoever waits for it."""

from __future__ import annotations

import contextlib
import os
import signal

from envhub_sandbox.option_names import option_name

_KILLED_IN_A_CONTAINER = 128
"""And the signal's number: an engine's exit code, where the container's program got one."""


def how(process_fd: int) -> str:
    """What is known of it and what to do, as the rest of a sentence. It stays to be reaped.

    Args:
        process_fd: A pidfd of it, or of the monitor of its container.
    """
    told = None
    with contextlib.suppress(OSError):  # another has waited for it, or it is no process
        told = os.waitid(os.P_PIDFD, process_fd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    if told is None:
        return f". {_next()}"
    if told.si_code in (os.CLD_KILLED, os.CLD_DUMPED):
        return f" by {_named(told.si_status)}{_culprit(told.si_status)}. {_next()}"
    number = told.si_status - _KILLED_IN_A_CONTAINER
    if number in signal.valid_signals():
        where = "; the container's own limit is DockerSandbox(memory=...) in Python"
        why = _culprit(number) + (where if number == signal.SIGKILL else "")
        return f" with its container, by {_named(number)}{why}. {_next()}"
    return f", with exit code {told.si_status}. {_next()}"


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
    return ", by somebody or by the kernel, as where memory runs out (dmesg says so)"

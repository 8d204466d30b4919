"""``--deadline`` interrupts what takes longer, whatever error is made of the interrupt."""

from __future__ import annotations

import signal
import threading

import pytest

from envhub_sandbox.cli.check.deadline import DeadlineReached, deadline_alarm


@pytest.mark.parametrize("translates", [False, True])
def test_what_takes_longer_is_interrupted(translates: bool) -> None:
    """Whatever it waits for, and whatever it makes of the interrupt."""
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(DeadlineReached), deadline_alarm(0.01):
        wait(translates)
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def wait(translates: bool) -> None:
    try:
        threading.Event().wait(60)
    except KeyboardInterrupt as error:
        if translates:
            raise OSError("the download broke off") from error
        raise


def test_an_error_before_it_is_what_it_is() -> None:
    with pytest.raises(OSError, match="its own"), deadline_alarm(60):
        raise OSError("its own")
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)

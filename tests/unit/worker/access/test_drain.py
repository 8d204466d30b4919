"""A server that is about to end: nothing new comes in, and what runs has its time."""

from __future__ import annotations

from unittest.mock import MagicMock

import pytest

from envhub_worker.access.drain import Drain
from envhub_worker.access.quotas import BusyError


def test_what_runs_has_its_time_and_nothing_new_comes_in() -> None:
    now = [0.0]
    drain = Drain(60.0, lambda: now[0])
    drain.refuse_new()
    assert (drain.begun, drain.over, drain.left_s) == (False, False, None)
    assert drain.begin(MagicMock())
    now[0] = 59.0
    assert not drain.begin(MagicMock())
    assert (drain.begun, drain.over, drain.left_s) == (True, False, 1.0)
    with pytest.raises(BusyError):
        drain.refuse_new()
    now[0] = 61.0
    assert (drain.over, drain.left_s) == (True, 0.0)
    assert not Drain(0.0).begin(MagicMock()), "there is no time to give"


def test_the_last_client_has_a_moment_to_hear_why() -> None:
    """It is quiet once no jail has been open for a while, and a new one begins that again."""
    now = [0.0]
    drain = Drain(60.0, lambda: now[0])
    for busy, at, quiet in (
        *((False, 0.0, False), (False, 0.9, False), (True, 1.0, False)),
        *((False, 1.1, False), (False, 2.0, False), (False, 2.1, True)),
    ):
        now[0] = at
        assert drain.quiet(busy) is quiet

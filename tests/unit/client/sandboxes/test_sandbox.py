"""When another place of a fleet is worth a try, and what is said where none takes a worker."""

from __future__ import annotations

import pytest

from envhub_sandbox.errors import (
    EnvHubError,
    LoadError,
    PolicyError,
    SandboxUnavailableError,
    ServerBusyError,
    WorkerDiedError,
    WorkerStartupError,
    WorkerTimeoutError,
)
from envhub_sandbox.sandboxes.sandbox import may_go_elsewhere, worst_of
from envhub_sandbox.transport.tcp import UnreachableError

BUSY = ServerBusyError("a: no room")


@pytest.mark.parametrize(
    ("error", "elsewhere"),
    [
        (BUSY, True),
        (UnreachableError("nothing answers"), True),
        (WorkerStartupError("it did not start"), True),
        (WorkerDiedError("lost", reason="connection"), True),
        (WorkerDiedError("ended", reason="server"), True),
        (WorkerTimeoutError("the worker did not answer in time"), True),
        (LoadError("the repository failed"), False),
        (WorkerDiedError("it was killed", reason="signal"), False),
        (WorkerTimeoutError("make_env takes too long", request="make_env"), False),
        (SandboxUnavailableError("the server does not know our key"), False),
        (PolicyError("not permitted"), False),
    ],
)
def test_a_place_that_is_full_or_not_there_is_followed_by_the_next(
    error: EnvHubError, elsewhere: bool
) -> None:
    """What would be the same elsewhere is not tried again, or is a mistake to be known."""
    assert may_go_elsewhere(error) is elsewhere


def test_the_error_for_all_is_one_that_may_pass() -> None:
    """With what each place has said; a single place's error stays as it is."""
    lost = WorkerDiedError("b: lost\nmore of it", reason="connection")
    found = worst_of([lost, BUSY])
    assert found is BUSY
    assert str(found) == "a: no room\nThe other places of the fleet:\nb: lost"
    assert worst_of([lost]) is lost
    assert str(lost) == "b: lost\nmore of it"

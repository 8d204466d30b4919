"""An error says whose it is, and where that runs: once, in its first line."""

from __future__ import annotations

import pytest

from envhub_sandbox.errors import LocalProtocolError, RemoteEnvError, WorkerDiedError, remote_error
from tests.attacks.client.lying_server import NUM_ENVS
from tests.support.in_process.fake_lane import FakeLane, session_over


@pytest.mark.parametrize(
    ("rows", "named"),
    [((1, 2), "sub-environment 1 of 2"), ((0, NUM_ENVS), "sub-environments 0 to 1 of 2")],
)
def test_the_first_line_names_the_rows_and_the_place(rows: tuple[int, int], named: str) -> None:
    """What follows it, and further arguments, stay; a second naming adds nothing."""
    part = session_over(FakeLane(rows[1] - rows[0]), rows)
    error = WorkerDiedError("it has ended\nits last words")
    error.args = (*error.args, "more")
    for _ in range(2):
        part.name_in(error)
        assert error.args == (f"it has ended ({named}, on here)\nits last words", "more")
    assert part.rows == rows
    session_over(FakeLane(1), (0, 1)).name_in(error)
    assert error.args[0].splitlines()[0].endswith("on here) (sub-environment 0 of 2, on here)")


def test_errors_of_others_keep_their_text() -> None:
    part = session_over(FakeLane(1), (0, 1))
    theirs = remote_error("ValueError", "ValueError", "size")
    assert isinstance(theirs, RemoteEnvError)
    bare = WorkerDiedError("")
    bare.args = ()
    for error in (theirs, LocalProtocolError("a lambda cannot be sent"), bare):
        before = error.args
        part.name_in(error)
        assert error.args == before

"""A worker that lies about what it watches: about values that are kept, and about changes."""

from typing import Any

import numpy as np
import pytest

from envhub_sandbox.errors import RemoteProtocolError
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.prefix import CHANGES
from tests.attacks.client.lies import ACTIONS, opened, relayed
from tests.attacks.client.lying_server import NUM_ENVS, LyingServer, step_done

TRUE = ("reach",) * NUM_ENVS


@pytest.fixture(autouse=True)
def _honest(liar: LyingServer) -> None:
    """Of what it is to watch the liar says the truth, unless a test has it lie."""
    liar.lies[m.Watch] = relayed(m.WatchDone(TRUE, True))


def watching(liar: LyingServer, folder: str) -> Any:
    """An environment after two rounds of an evaluation; its suites."""
    suites = opened(liar, folder)
    suites.env.reset()
    for _ in range(2):
        suites.env.step(ACTIONS)
        suites.env.get_attr("task")
    return suites


def test_values_are_kept_while_nothing_is_said(liar: LyingServer, folder: str) -> None:
    """The control: who is honest is believed, and asked no more."""
    with watching(liar, folder) as suites:
        before = suites.env.sandbox.stats()["requests"]
        for _ in range(20):
            suites.env.step(ACTIONS)
            assert suites.env.get_attr("task") == TRUE
        assert suites.env.sandbox.stats()["requests"] == before + 20


LIES: dict[str, list[m.Message]] = {
    "too many": [m.Changes(((1, "task"),) * (CHANGES.most + 1))],
    "a giant": [m.Changes(((1, "x" * 4_000_000),))],
    "no name": [m.Changes(((1, 1),))],
    "no pairs": [m.Changes(("task",))],
    "an array": [m.Changes((np.zeros(10_000),))],
    "a flood": [m.Changes(((1, "task"),))] * (DEFAULT_LIMITS.frames // 4),
}


@pytest.mark.parametrize("lie", LIES)
def test_lies_about_changes_are_refused(liar: LyingServer, folder: str, lie: str) -> None:
    """Its environment dies of them, as of any other lie; the control hears of a true one."""
    true = [m.Changes(((1, "task"), (99, "other")))]
    for said, breaks in ((LIES[lie], True), (true, False)):
        liar.lies.pop(m.Step, None)
        with watching(liar, folder) as suites:
            liar.lies[m.Step] = relayed(*said, step_done())
            if breaks:
                with pytest.raises(RemoteProtocolError):
                    suites.env.step(ACTIONS)
            else:
                suites.env.step(ACTIONS)


def test_what_can_be_changed_is_not_kept(liar: LyingServer, folder: str) -> None:
    liar.lies[m.Watch] = relayed(m.WatchDone(tuple([["reach"]] * NUM_ENVS), True))
    with watching(liar, folder) as suites:
        before = suites.env.sandbox.stats()["requests"]
        for _ in range(5):
            suites.env.step(ACTIONS)
            suites.env.get_attr("task")
        assert suites.env.sandbox.stats()["requests"] == before + 10


@pytest.mark.parametrize(
    "lie",
    [m.WatchDone(("reach",), True), m.WatchDone("reach", True), m.Value(TRUE)],
    ids=["too few", "no tuple", "another reply"],
)
def test_other_answers_are_refused(liar: LyingServer, folder: str, lie: m.Message) -> None:
    liar.lies[m.Watch] = relayed(lie)
    with pytest.raises(RemoteProtocolError):
        watching(liar, folder)

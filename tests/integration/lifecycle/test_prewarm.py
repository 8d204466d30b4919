"""Processes that start before anybody asks for them."""

from __future__ import annotations

import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import make_env
from envhub_sandbox.errors import WorkerError
from tests.support.processes import descendants, eventually
from tests.support.samples import sample

# when a jail is started and given up is up to the client, whoever that is
pytestmark = pytest.mark.same_for("users")


@pytest.fixture(autouse=True)
def _known() -> None:
    """Its manifest is remembered from here on, so that making it again starts nothing."""
    with make_env(sample("counter"), n_envs=2):
        pass


def test_the_first_reset_finds_what_was_started() -> None:
    """One start, before any request; to prewarm what is warm does nothing."""
    with make_env(sample("counter"), n_envs=2) as suites:
        env = suites.env
        assert env.sandbox.stats()["state"] == "IDLE"
        env.prewarm()
        env.prewarm()
        assert eventually(lambda: env.sandbox.stats()["state"] == "READY")
        started = descendants()
        env.prewarm()
        env.reset(seed=0)
        assert descendants() <= started  # what others left to linger may end meanwhile
        assert env.sandbox.stats()["requests"] == 1
    with make_env(sample("counter"), n_envs=2) as suites:
        suites.env.prewarm()
        assert len(suites.env.reset(seed=0)[0]) == 2, "a reset in its midst waits for it"
        assert suites.env.sandbox.stats()["state"] == "READY"


def test_closed_in_the_midst_it_leaves_nothing() -> None:
    before = descendants()
    for _ in range(5):
        suites = make_env(sample("counter"), n_envs=2, timeouts={"server_idle_s": 0})
        suites.env.prewarm()
        suites.close()
        assert suites.env.sandbox.stats()["state"] == "CLOSED"
        with pytest.raises(ClosedEnvironmentError):
            suites.env.prewarm()
    assert eventually(lambda: descendants() <= before)


def test_what_fails_is_raised_by_the_first_request() -> None:
    with make_env(sample("counter"), n_envs=2, timeouts={"startup_s": 0.001}) as suites:
        suites.env.prewarm()
        with pytest.raises(WorkerError):
            suites.env.reset(seed=0)
        assert suites.env.sandbox.stats()["state"] == "IDLE"

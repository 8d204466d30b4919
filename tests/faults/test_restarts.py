"""How often, and how soon, a worker that died is replaced."""

from typing import Any

import pytest

from envhub_sandbox import errors, make_env
from envhub_sandbox.settings.policy import Policy
from tests.support.samples import sample

pytestmark = pytest.mark.short


def made(**policy: Any) -> Any:
    fails = {"moment": "step", "fault": "kill"}
    return make_env(sample("faulty"), n_envs=2, env_kwargs=fails, policy=policy)


@pytest.mark.usefixtures("neighbour")
def test_never_means_never() -> None:
    """Without a policy for it, everything after a death says that it has died, and what to do."""
    with made() as suites:
        env = suites.env
        env.reset()
        with pytest.raises(errors.WorkerDiedError):
            env.step([0, 1])
        for operation in (env.reset, lambda: env.step([0, 0]), env.render):
            with pytest.raises(errors.WorkerDiedError, match="on_reset"):
                operation()


@pytest.mark.usefixtures("neighbour")
def test_budget_ends() -> None:
    with made(restart="on_reset", restart_budget=2, restart_backoff_s=0) as suites:
        env = suites.env
        for _ in range(3):
            env.reset()
            with pytest.raises(errors.WorkerDiedError, match="died during step"):
                env.step([0, 1])
        for _ in range(2):
            with pytest.raises(errors.WorkerDiedError, match=r"all 2 restarts.*restart_budget"):
                env.reset()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("restart_budget", -1),
        ("restart_budget", 1.5),
        ("restart_budget", True),
        ("restart_backoff_s", -0.1),
        ("restart_backoff_s", float("nan")),
        ("restart_backoff_s", float("inf")),
        ("restart_backoff_s", "soon"),
    ],
)
def test_impossible_values_are_refused(name: str, value: Any) -> None:
    with pytest.raises(errors.PolicyError, match=name):
        Policy(**{name: value})

"""``EnvSuites.map``: many tasks at once, over whatever the sandbox is."""

import threading
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from tests.support import inside
from tests.support.samples import sample


def _return_of(suite: str, task: Any, env: Any) -> float:
    env.reset(seed=1)
    actions = env.action_space
    actions.seed(2)
    return float(sum(np.sum(env.step(actions.sample())[1]) for _ in range(5)))


def test_what_comes_of_tasks_does_not_depend_on_how_many_live() -> None:
    """Two at once over a fleet, one started ahead: the same as one after the other."""
    options: dict[str, Any] = {"n_envs": 2, "env_kwargs": {"tasks": 6}}
    with make_env(sample("many_tasks"), **options) as suites:
        alone = {
            suite: {task: _return_of(suite, task, env) for task, env in tasks.items()}
            for suite, tasks in suites.items()
        }
    lock, most = threading.Lock(), [0]

    def play(suite: str, task: Any, env: Any) -> float:
        result = _return_of(suite, task, env)
        with lock:
            sessions = [inside.session(e) for tasks in suites.values() for e in tasks.values()]
            most[0] = max(most[0], sum(s.lifecycle.state.name == "READY" for s in sessions))
        return result

    with make_env(sample("many_tasks"), sandbox=["process", "process"], **options) as suites:
        assert suites.map(play, max_live_tasks=3) == alone
        assert 1 <= most[0] <= 3
        assert all(env.closed for tasks in suites.values() for env in tasks.values())


def test_a_budget_of_memory_counts_each_worker() -> None:
    """By the policy's limit of a jail, and as many jails as a task has workers."""
    options: dict[str, Any] = {"n_envs": 2, "limits": {"memory_bytes": 1 << 30}}
    with make_env(sample("many_tasks"), sandbox=["process"] * 2, **options) as suites:
        first = next(iter(next(iter(suites.values())).values()))
        assert first.sandbox.memory_limit() == 2 << 30
        with pytest.raises(ValueError, match="one task may take 2"):
            suites.map(_return_of, memory="1G")
        assert suites.map(_return_of, memory="4G")

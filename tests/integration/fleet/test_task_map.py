"""Tasks over a fleet, and the page about fleets."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from tests.remote.listening import Listening
from tests.support import inside
from tests.support.documents import blocks
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


DOCUMENT = "docs/scaling.md"


def test_the_python_of_the_page_runs(rows: Path, servers: list[Listening]) -> None:
    """Block by block, with what the page presupposes; the places are servers of this machine."""
    here = [server.sandbox() for server in servers[:2]]
    made: list[Any] = []

    def make(reference: str, *, sandbox: Any, n_envs: int, num_workers: int, **options: Any) -> Any:
        assert isinstance(sandbox, list)
        found = make_env(rows, sandbox=here, n_envs=n_envs, num_workers=num_workers, **options)
        made.append(found)
        return found

    def evaluate(env: Any) -> float:
        env.reset(seed=0)
        return float(env.step(np.zeros(env.num_envs, int))[1].sum())

    suites = make_env(rows, sandbox=here, n_envs=4)
    suites.env.reset()
    names: dict[str, Any] = {"make_env": make, "evaluate": evaluate, "suites": suites}
    names |= {"REF": "org/repo", "n_envs": 128, "world_size": 2, "rank": 1, "seed": 5}
    names["env"] = suites.env
    there = [one for one in blocks.tested(blocks.RUN) if one.document == DOCUMENT]
    texts = [one.text for one in there if one.language == "python"]
    assert len(texts) == 4
    for text in texts:
        exec(text, names)
    assert names["slowest"]["place"] in {one.endpoint for one in here}
    assert (names["returns"], names["env"].num_envs) == ({"hub_env": {0: 4.0}}, 64)
    for one in made:
        one.close()

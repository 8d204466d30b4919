"""What ``envhub run`` does with the environments that it is given; nothing here is sandboxed."""

import json
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.vector import SyncVectorEnv
from typer.testing import CliRunner

from envhub_sandbox.cli.app import app
from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.vector.suites import EnvSuites

PROVENANCE = {"repository": "r", "repo_type": "model", "commit": "c", "path": "env.py"}


class Noted(SyncVectorEnv):
    """CartPoles that note when they are reset and closed."""

    def __init__(self, task: int, events: list[tuple[str, int]]) -> None:
        super().__init__([lambda: gym.make("CartPole-v1")])
        self.task, self.events = task, events

    def reset(self, **kwargs: Any) -> Any:
        self.events.append(("reset", self.task))
        return super().reset(**kwargs)

    def close(self, **kwargs: Any) -> None:
        if not self.closed:
            self.events.append(("close", self.task))
        super().close(**kwargs)


class Dying(Noted):
    """Dies in its first step."""

    def step(self, actions: Any) -> Any:
        raise WorkerDiedError("it died", log_tail="")


def run(
    monkeypatch: pytest.MonkeyPatch, make_env: Callable[..., EnvSuites], *arguments: str
) -> tuple[int, dict[str, Any]]:
    """The exit code and the document of a run in which ``make_env`` is replaced."""
    monkeypatch.setattr("envhub_sandbox.factory.make_env.make_env", make_env)
    done = CliRunner().invoke(app, ["run", "org/repo", "--episodes", "2", "--json", *arguments])
    text = done.stdout  # older versions of the runner mix stderr into it
    return done.exit_code, json.loads(text[text.index("{") : text.rindex("}") + 1])


def suites(*envs: SyncVectorEnv) -> EnvSuites:
    return EnvSuites({"s": dict(enumerate(envs))}, lambda: dict(PROVENANCE))


def test_each_task_is_closed_before_the_next_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[tuple[str, int]] = []
    envs = suites(Noted(0, events), Noted(1, events))
    code, document = run(monkeypatch, lambda **kwargs: envs)
    assert code == 0
    assert events == [("reset", 0), ("close", 0), ("reset", 1), ("close", 1)]
    assert [len(task["episodes"]) for task in document["tasks"]] == [2, 2]


def test_a_failing_task_ends_the_run_and_closes_all(monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[tuple[str, int]] = []
    envs = suites(Noted(0, events), Dying(1, events), Noted(2, events))
    code, document = run(monkeypatch, lambda **kwargs: envs)
    assert code == 5
    assert events[-2:] == [("close", 1), ("close", 2)]
    assert [task["task"] for task in document["tasks"]] == [0]
    died = {"type": "WorkerDiedError", "message": "it died", "exit_code": 5, "bundle": None}
    assert document["error"] == died

"""``lerobot-eval`` gets the same numbers from the proxy as from an in-process environment."""

from pathlib import Path
from typing import Any

import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import make_env
from tests.support.compare import assert_same
from tests.support.repositories import write_repository
from tests.support.samples import Frozen, make_env_of, reference, sample

torch = pytest.importorskip("torch")
lerobot = pytest.importorskip("tests.support.lerobot")
SUITE = """
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from swing_up import SwingUp

def make_env(n_envs=1, use_async_envs=False):
    vector = AsyncVectorEnv if use_async_envs else SyncVectorEnv
    return {
        "pendulum": {
            task: vector([lambda task=task: SwingUp(f"swing_up_{task}")] * n_envs)
            for task in range(3)
        }
    }
"""


def policy(batch: dict[str, Any]) -> Any:
    """Pushes against the velocity; the longer the task's name, the harder."""
    assert all(task.endswith("the pendulum") for task in batch["task"])
    velocity = batch["observation.state"][:, 2:3]
    return torch.clamp(-velocity, -2, 2)


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    swing_up = (sample("lerobot_pendulum") / "env.py").read_text().replace('fps": 20', 'fps": 12.5')
    folder = write_repository(tmp_path / "pendulum_suite", SUITE, swing_up__py=swing_up)
    monkeypatch.syspath_prepend(str(folder))
    return folder


@pytest.mark.parametrize(("mode", "use_async_envs"), [("NextStep", False), ("SameStep", True)])
def test_rollout_is_the_same(mode: str, use_async_envs: bool) -> None:
    """Every tensor is equal to those of LeRobot's wrapper, tasks and frames included."""
    kwargs = {"autoreset_mode": mode}
    frames: tuple[list[Any], list[Any]] = ([], [])
    plain: Any = reference("lerobot_pendulum", 3, **kwargs)
    plain.envs = [Frozen(one) for one in plain.envs]
    expected = lerobot.rollout(plain, policy, [4, 5, 6], frames[0])
    made = make_env(
        sample("lerobot_pendulum"), n_envs=3, use_async_envs=use_async_envs, env_kwargs=kwargs
    )
    with made as suites:
        actual = lerobot.rollout(suites.env, policy, [4, 5, 6], frames[1])
    assert_same(expected, actual)
    assert_same(*frames)


@pytest.mark.parametrize(("max_parallel_tasks", "use_async_envs"), [(1, False), (3, True)])
def test_evaluation_of_a_suite_is_the_same(
    repository: Path, use_async_envs: bool, max_parallel_tasks: int
) -> None:
    """Metrics of every task agree, one by one and from a pool of threads; also a second time, for
    which what the first one closed is opened again. For a caller of Gymnasium it stays closed.
    LeRobot's videos take a whole number of frames in a second; Gymnasium's take this one."""
    expected = lerobot.evaluate_all(make_env_of(repository)(n_envs=2), policy, 3, 1)
    for result in expected.values():
        result["fps"] = round(result["fps"])
    options: Any = {"n_envs": 2, "use_async_envs": use_async_envs}
    envs = make_env(repository, **options, trust_remote_code=True)
    for _ in range(2):
        actual = lerobot.evaluate_all(envs, policy, 3, max_parallel_tasks)
        assert_same(expected, dict(sorted(actual.items())))
        assert all(env.closed and not env.sandbox.report() for env in envs["pendulum"].values())
    lerobot.close_envs(envs)
    envs.close()
    env = envs["pendulum"][0]
    with pytest.raises(ClosedEnvironmentError, match="reset opens it again"):
        env.step(env.action_space.sample())
    with make_env(repository, **options) as refusing:
        env = refusing["pendulum"][0]
        assert env.metadata["render_fps"] == 12.5
    with pytest.raises(ClosedEnvironmentError, match=r"pendulum_suite.*: make_env makes another"):
        env.reset(seed=0)


def test_missing_task_falls_back_as_in_lerobot() -> None:
    """An environment without a task gives empty ones: the error is an AttributeError."""
    with make_env(sample("pendulum"), n_envs=2) as suites:
        suites.env.reset(seed=0)
        assert lerobot.tasks_of(suites.env) == ["", ""]
        assert not lerobot.has_attribute(suites.env, "task")
        assert suites.env.call("_max_episode_steps") == (25, 25)


class TestWithoutSandbox:
    """``sandbox=None`` is LeRobot's own way: in this process, after explicit consent."""

    def test_refusal_without_consent(self) -> None:
        """The message is LeRobot's, and nothing is asked of the network before it."""
        with pytest.raises(RuntimeError, match="Refusing to execute remote code from the Hub") as e:
            make_env("nobody/nothing", sandbox=None, endpoint="http://127.0.0.1:9")
        for part in (
            "'nobody/nothing'",
            "trust_remote_code=True",
            "user/repo@<commit-hash>:env.py",
        ):
            assert part in str(e.value)

    def test_with_consent_it_runs_here(self) -> None:
        """With consent the result is a plain vector environment with the same results."""
        expected = reference("cartpole", 2)
        with make_env(sample("cartpole"), n_envs=2, sandbox=None, trust_remote_code=True) as suites:
            assert suites.env.unwrapped.envs[0].unwrapped.__class__.__name__ == "CartPoleEnv"
            assert_same(expected.reset(seed=1), suites.env.reset(seed=1))
            assert_same(expected.step([0, 1]), suites.env.step([0, 1]))

"""Environments by other authors, through ``make_env``, each for what is special about it."""

import os
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode

from envhub_sandbox import EnvSuites, make_env
from envhub_sandbox.sandboxes.pool import stop_idle
from tests.support.compare import assert_same
from tests.support.processes import descendants, eventually
from tests.support.samples import make_env_of, reference, sample


@pytest.mark.parametrize(
    ("name", "shape"),
    [("lunar_lander", (400, 600, 3)), ("half_cheetah", (48, 64, 3)), ("pusht", (680, 680, 3))],
)
def test_frames_are_the_reference_frames(name: str, shape: tuple[int, ...]) -> None:
    expected = reference(name, 2)
    with make_env(sample(name), n_envs=2) as suites:
        for env in (expected, suites.env):
            env.reset(seed=3)
        frames = suites.env.render()
        assert isinstance(frames, tuple)
        assert [frame.shape for frame in frames] == [shape, shape]
        assert_same(expected.render(), frames)
    expected.close()


def test_vector_rewards_of_async_envs() -> None:
    """With AsyncVectorEnv, vector rewards are float64 ``(num_envs, objectives)``."""
    with make_env(sample("mo_gymnasium"), n_envs=3, use_async_envs=True) as suites:
        suites.env.reset(seed=0)
        _, rewards, *_ = suites.env.step([1, 1, 3])
        assert (rewards.dtype, rewards.shape) == (np.dtype(np.float64), (3, 2))


class TestTorchObservations:
    """An environment that answers in tensors, as LeRobot's IsaacLab Arena does."""

    def test_tensors_arrive_as_tensors(self) -> None:
        """Observations are the reference's tensors, and rewards its arrays; a tensor is an action,
        too. What its own class says of itself comes along."""
        torch = pytest.importorskip("torch")
        expected = reference("torch_obs", 2)
        actions = np.full((2, 3), 0.25, np.float32)
        with make_env(sample("torch_obs"), n_envs=2) as suites:
            env = suites.env
            assert_same(expected.reset(seed=1), env.reset(seed=1))
            for _ in range(12):
                result = env.step(actions)
                assert_same(expected.step(actions), result)
            assert isinstance(result[0]["policy"]["joint_pos"], torch.Tensor)
            assert isinstance(result[1], np.ndarray)
            results = []
            for given in (torch.full((2, 3), 0.5), np.full((2, 3), 0.5, np.float32)):
                env.reset(seed=1)
                results.append(env.step(given))
            assert_same(results[0], results[1])
            assert env.hub_config == {"embodiment": "gr1", "cameras": ["front"]}
            assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


class TestLeRobotDocs:
    """The two examples of LeRobot's EnvHub documentation, used as it uses them."""

    def test_single_task(self) -> None:
        envs_dict = make_env(sample("lerobot_docs_single"), n_envs=4, use_async_envs=True)
        suite_name = next(iter(envs_dict))
        env = envs_dict[suite_name][0]
        env.reset()
        done = np.zeros(env.num_envs, dtype=bool)
        total_reward = np.zeros(env.num_envs)
        while not done.all():
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total_reward += reward
            done |= terminated | truncated
        assert (total_reward > 0).all()
        env.close()
        envs_dict.close()

    def test_multi_task(self) -> None:
        in_process = make_env_of(sample("lerobot_docs_multitask"))(n_envs=2)
        with make_env(sample("lerobot_docs_multitask"), n_envs=2, use_async_envs=True) as suites:
            names = [(suite, list(tasks)) for suite, tasks in suites.items()]
            assert names == [("suite_1", [0, 1]), ("suite_2", [0])]
            for suite, tasks in suites.items():
                for task, env in tasks.items():
                    expected = in_process[suite][task]
                    assert_same(expected.reset(seed=2), env.reset(seed=2))
                    expected.action_space.seed(2)
                    for _ in range(60):
                        actions = expected.action_space.sample()
                        assert_same(expected.step(actions), env.step(actions))


@pytest.mark.short
class TestManyTasks:
    """Tasks of four environments with ``use_async_envs``: processes only while in use."""

    @pytest.fixture
    def suites(self) -> Any:
        options: Any = {"n_envs": 4, "use_async_envs": True, "env_kwargs": {"tasks": 4}}
        with make_env(sample("many_tasks"), **options) as made:
            yield made

    def test_processes_only_for_the_task_in_use(self, suites: EnvSuites) -> None:
        """However many tasks: never more than those of one in use, and of the next one."""
        assert list(suites["rooms"]) == list(range(4))
        before, server, jail = descendants(), 3, 4
        for task, env in suites["rooms"].items():
            env.reset(seed=task)
            env.step([1, 0, 1, 0])
            # who has closed one does not wait until its last process has gone
            assert eventually(lambda: len(descendants() - before) <= server + 2 * jail)
            env.close()
        assert eventually(lambda: len(descendants() - before) <= server + jail)
        suites.close()
        stop_idle()
        assert eventually(lambda: descendants() <= before)

    def test_sub_environments_run_in_processes_of_their_own(self, suites: EnvSuites) -> None:
        """Closing one task leaves the others."""
        first, second = suites["rooms"][0], suites["rooms"][1]
        first.reset(seed=0)
        pids = first.get_attr("pid")
        assert len(set(pids)) > 1 or len(os.sched_getaffinity(0)) == 1  # a core for each
        _, _, _, _, infos = first.step([0, 0, 0, 0])
        assert infos["pid"].tolist() == list(pids)
        second.reset(seed=0)
        first.close()
        first.close()
        assert first.closed
        with pytest.raises(ClosedEnvironmentError):
            first.step([0, 0, 0, 0])
        second.step([1, 1, 1, 1])

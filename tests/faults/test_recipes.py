"""A proxy in a pickle is a recipe: the other process gets an environment and worker of its own."""

import multiprocessing
import pickle
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox import make_env
from tests.support import inside
from tests.support.samples import sample


def tenth_step(env: Any) -> list[list[float]]:
    """In a child: use the environment that came in a pickle, and close it."""
    env.reset(seed=0)
    for _ in range(9):
        env.step([0, 0])
    observations = env.step([0, 0])[0].tolist()
    env.close()
    return observations


@pytest.mark.usefixtures("neighbour")
def test_spawned_child_has_its_own() -> None:
    """RLlib and SB3 send environments to spawned children; ours goes on meanwhile."""
    made = make_env(sample("faulty"), n_envs=2, use_async_envs=True)
    with made as suites, multiprocessing.get_context("spawn").Pool(1) as pool:
        suites.env.reset()
        suites.env.step([0, 0])
        assert pool.apply(tenth_step, (suites.env,)) == [[10.0], [10.0]]
        assert suites.env.step([0, 0])[0].tolist() == [[2.0], [2.0]]


@pytest.mark.usefixtures("neighbour")
def test_options_and_tasks_travel() -> None:
    """Arguments, timeouts, policy and the chosen task are the same on the other side."""
    with make_env(
        sample("faulty"),
        n_envs=3,
        env_kwargs={"tasks": 2},
        timeouts={"step_s": 12.5},
        policy={"restart": "on_reset", "lane": "frames"},
    ) as suites:
        with pickle.loads(pickle.dumps(suites)) as again:
            assert list(again["suite"]) == [0, 1]
            assert again is not suites
        one = pickle.loads(pickle.dumps(suites["suite"][1]))
        assert (one.num_envs, inside.repository(one).timeouts.step_s) == (3, 12.5)
        assert inside.repository(one).policy.restart == "on_reset"
        assert (inside.repository(one).policy.lane, inside.manifest(one).task) == ("frames", 1)
        one.close()


@pytest.mark.usefixtures("neighbour")
def test_config_object_travels_as_its_attributes() -> None:
    config = SimpleNamespace(
        hub_path=str(sample("cfg_reader")),
        task="CartPole-v1",
        episode_length=5,
        camera={"width": 64},
        robot=SimpleNamespace(name="arm"),
        secret=lambda: 0,
    )
    with make_env(config) as suites:
        recipe = inside.recipe(suites)
        assert "secret" not in recipe.config
        with pickle.loads(pickle.dumps(suites)) as again:
            for name in ("camera_width", "robot"):
                assert again.env.get_attr(name) == suites.env.get_attr(name)


@pytest.mark.usefixtures("neighbour")
def test_what_lerobot_opens_again_is_a_copy_without_the_token() -> None:
    """Of one and of all. One of this process cannot be had elsewhere."""
    options: dict[str, Any] = {"n_envs": 2, "trust_remote_code": True}
    with make_env(sample("faulty"), token="hf_do_not_tell", **options) as suites:
        for made in (suites, suites.env):
            data = pickle.dumps(made)
            assert b"hf_do_not_tell" not in data
            one = pickle.loads(data).env if made is suites else pickle.loads(data)
            one.close()
            assert one.reset()[0].tolist() == [[0.0], [0.0]]
            one.close()
    with (
        make_env(sample("faulty"), sandbox=None, **options) as suites,
        pytest.raises(TypeError, match="in this process"),
    ):
        pickle.dumps(suites)

"""How environments of ``gym`` are seeded and drawn: by what they take, whatever their release."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from envhub_worker.extras import old_gym
from envhub_worker.runner.tasks import ResultError, tasks_of

OBSERVATION = np.zeros(2, np.float32)


class Box:
    """A space as ``gym`` has it, by the name of its module."""

    low, high, shape, dtype = -np.ones(2, "f4"), np.ones(2, "f4"), (2,), np.dtype(np.float32)

    def contains(self, value: Any) -> bool:
        return isinstance(value, np.ndarray)


class Tuple:
    """One with parts."""

    def __init__(self, *spaces: Any) -> None:
        self.spaces = spaces

    def contains(self, value: Any) -> bool:
        return isinstance(value, tuple)


class Env:
    """What all environments of ``gym`` are derived from."""

    observation_space: Any = Box()
    action_space: Any = Box()
    asked: tuple[Any, ...] = ()
    metadata: Any = {}  # noqa: RUF012

    def seed(self, seed: Any = None) -> None:
        self.asked += ("seed", seed)


class Wrapper(Env):
    """A wrapper that passes on what it is given."""

    def __init__(self, env: Any) -> None:
        self.env = env

    @property
    def metadata(self) -> Any:
        return self.env.metadata

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)

    def seed(self, seed: Any = None) -> None:
        self.env.seed(seed)

    def render(self, mode: str = "human", **kwargs: Any) -> Any:
        return self.env.render(mode=mode, **kwargs)


Env.__module__ = Wrapper.__module__ = "gym.core"
Box.__module__ = Tuple.__module__ = "gym.spaces.some"


class Bare(Env):
    """As before 0.22."""

    metadata = {"render.modes": ["human", "rgb_array"]}  # noqa: RUF012

    def reset(self) -> Any:
        self.asked += ("reset",)
        return OBSERVATION

    def render(self, mode: str = "human") -> Any:
        return mode


class Between(Env):
    """As from 0.22 to 0.25."""

    def reset(self, *, seed: Any = None, return_info: bool = False, options: Any = None) -> Any:
        self.asked += ("reset", seed, options)
        return (OBSERVATION, {"n": 1}) if return_info else OBSERVATION

    def render(self, *args: Any, **kwargs: Any) -> Any:
        return kwargs.get("mode")


class Deaf(Bare):
    """Somebody's, whose ``seed`` takes nothing."""

    def seed(self) -> None:
        raise AssertionError


class Last(Env):
    """As 0.26."""

    render_mode = "rgb_array"

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.asked += ("reset", seed, options)
        return OBSERVATION, {"n": 1}

    def render(self) -> Any:
        return "by its own mode"


class Blind(Wrapper):
    """A wrapper of somebody's that passes nothing on."""

    def reset(self) -> Any:
        return self.env.reset()


@pytest.mark.parametrize(
    ("env", "asked", "info"),
    [
        (Bare(), ("seed", 3, "reset"), {}),
        (Wrapper(Bare()), ("seed", 3, "reset"), {}),
        (Wrapper(Deaf()), ("reset",), {}),
        (Wrapper(Between()), ("reset", 3, {"a": 1}), {"n": 1}),
        (Wrapper(Last()), ("reset", 3, {"a": 1}), {"n": 1}),
        (Wrapper(Blind(Between())), ("seed", 3, "reset", None, None), {}),
    ],
)
def test_it_is_seeded_by_what_every_layer_takes(env: Any, asked: Any, info: Any) -> None:
    with pytest.warns(UserWarning, match="gym .* is not maintained"):
        adapted = old_gym.adapted(env)
    assert isinstance(adapted, gymnasium.Env)
    observation, found = adapted.reset(seed=3, options={"a": 1})
    assert observation is OBSERVATION
    assert found == info
    while isinstance(env, Wrapper):
        env = env.env
    assert env.asked == asked


@pytest.mark.parametrize(
    ("env", "mode", "drawn"),
    [
        (Wrapper(Bare()), "rgb_array", "rgb_array"),
        (Between(), None, None),
        (Last(), "rgb_array", "by its own mode"),
    ],
)
def test_it_is_drawn_in_a_mode_that_needs_no_window(env: Any, mode: Any, drawn: Any) -> None:
    adapted = old_gym.OldEnv(env)
    assert adapted.render_mode == mode
    assert adapted.render() == drawn


def test_an_observation_of_two_parts_is_no_observation_and_info() -> None:
    class Paired(Bare):
        observation_space = Tuple(Box(), Box())

        def reset(self) -> Any:
            return OBSERVATION, {"looks": "like an info"}

    assert old_gym.OldEnv(Paired()).reset()[0] == (OBSERVATION, {"looks": "like an info"})


def test_a_space_without_a_counterpart_is_named() -> None:
    class Own:
        """A space of somebody's."""

    with pytest.raises(old_gym.OldSpaceError, match=r"test_old_gym\..*Own.*Box, Discrete"):
        old_gym.space_of(Tuple(Box(), Own()))


def test_an_attribute_is_set_where_it_is() -> None:
    env = Bare()
    env.gain = 1
    adapted = old_gym.OldEnv(Wrapper(env))
    adapted.gain = 2
    assert env.gain == adapted.gain == 2
    assert "gain" not in vars(adapted)


def test_a_step_that_a_later_gym_refuses_names_the_earlier() -> None:
    """Not for a class of Gymnasium, which has no earlier release with that API."""

    theirs: dict[str, Any] = {}
    step = "def step(self, action):\n    return None, 0.0, False, {}\n"
    exec(compile(step, "envs.py", "exec"), theirs)
    members = {"step": theirs["step"], "unwrapped": property(lambda env: env)}
    wrapper = compile("_, _, _, _, _ = env.step(0)", "gym/wrappers.py", "exec")
    for base, named in ((Env, True), (object, False)):
        env = type("Four", (base,), members)()
        with pytest.raises(ValueError, match="expected 5, got 4") as caught:
            exec(wrapper, {"env": env})
        told = old_gym.explained(caught.value, env, "step")
        assert ("pip install 'gym<0.26'" in str(told)) == named


def test_what_is_gymnasiums_stays_as_it_is(recwarn: Any) -> None:
    env = gymnasium.make("CartPole-v1")
    assert old_gym.adapted(env) is env
    assert not recwarn.list


def test_one_that_is_batched_is_refused() -> None:
    class Batched(Bare):
        num_envs = len(OBSERVATION)

    with pytest.raises(ResultError, match=f"num_envs is {len(OBSERVATION)} and whose spaces are"):
        tasks_of(Wrapper(Batched()), 1, False, Batched)
    assert len(tasks_of(Wrapper(Bare()), 1, False, Bare)) == 1  # the control

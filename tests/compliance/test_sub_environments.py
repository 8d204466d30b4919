"""One sub-environment at a time, and what is told of it: as in ``SyncVectorEnv``, in every way."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from envhub_worker.protocol.codec.inert import RemoteObject
from tests.compliance.theirs.through_sandbox import vector
from tests.remote.listening import Listening, listening
from tests.support.compare import assert_same, assert_same_space

WAYS: dict[str, dict[str, Any]] = {
    "plain": {},
    "subclass": {"options": {"env_kwargs": {"subclass": True}}},
    "tcp": {},  # by messages, as with the lane ``"frames"``
}


class Told(gym.Env[Any, Any]):
    """Tells what it has; its infos hold a space and its generator."""

    metadata: dict[Any, Any] = {"render_modes": [], 3: "three", ("a", None): 1.5}  # noqa: RUF012

    def __init__(self, number: int = 0) -> None:
        self.observation_space = spaces.Dict(
            {"b": spaces.Box(-1, 1, (2,)), "a": spaces.Graph(spaces.Box(0, 1, (1,)), None)}
        )
        self.action_space = spaces.Discrete(3, start=-1)
        self.number = number
        self.ran: list[str] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.ran.append("reset")
        return self.observation_space.sample(), {"space": self.action_space, "rng": self.np_random}

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        self.ran.append("step")
        observation, end = self.observation_space.sample(), bool(action == 1)
        return observation, float(self.np_random.random()), end, False, {"number": self.number}

    def add(self, count: int, *, twice: bool = False) -> int:
        self.number += count * (1 + twice)
        return self.number

    def close(self) -> None:
        self.ran.append("close")


def told(count: int) -> list[Callable[[], gym.Env[Any, Any]]]:
    return [lambda number=i: gym.wrappers.TimeLimit(Told(number), 9) for i in range(count)]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    with listening(tmp_path_factory.mktemp("server")) as found:
        yield found


@pytest.fixture(params=WAYS)
def make(request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    made: list[Any] = []
    options: dict[str, Any] = {}
    if request.param == "tcp":
        options = {"options": {"sandbox": request.getfixturevalue("server").sandbox()}}

    def build(env_fns: Any, **kwargs: Any) -> Any:
        made.append(vector(env_fns, **{**WAYS[request.param], **kwargs}))
        return made[-1]

    yield partial(build, **options)
    for env in made:
        env.close()


def facts(spec: Any) -> tuple[Any, ...]:
    return spec.id, spec.max_episode_steps, spec.reward_threshold, spec.nondeterministic


def test_one_alone_is_driven_behind_the_others_back(make: Callable[..., Any]) -> None:
    """What the vector environment then does is what ``SyncVectorEnv`` does, autoresets included."""

    def drive(env: Any) -> list[Any]:
        end, go = np.array([1, 0, 0]), np.zeros(3, np.int64)
        heard: list[Any] = [env.reset(seed=3), env.step(go)]
        heard += [env.envs[1].step(1), env.step(go)]  # over, and the vector has not seen it
        heard += [env.step(end), env.envs[0].reset(seed=9), env.step(go), env.step(go)]
        heard += [env.envs[2].reset(), env.envs[2].unwrapped.step(-1), env.envs[2].step(0)]
        ran = [one.unwrapped.ran for one in env.envs]
        return [*map(without_objects, heard), ran, env.get_attr("np_random")]

    expected, actual = SyncVectorEnv(told(3)), make(told(3))
    assert_same(drive(expected), drive(actual), "what was heard")


def without_objects(result: tuple[Any, ...]) -> tuple[Any, ...]:
    """A result whose infos hold no spaces."""
    hidden = ("space", "_space", "rng", "_rng")
    return (*result[:-1], {key: value for key, value in result[-1].items() if key not in hidden})


def test_attributes_and_methods_of_one(make: Callable[..., Any]) -> None:
    """Reading reads, calling calls that one alone, setting sets; wrappers are looked through."""

    def ask(env: Any) -> list[Any]:
        env.reset(seed=1)
        one = env.envs[1]
        one.unwrapped.color = "red"
        one.set_wrapper_attr("number", 7)
        return [
            *(one.unwrapped.number, one.env.number, one.get_wrapper_attr("number")),
            *(
                one.unwrapped.add(2),
                one.unwrapped.add(2, twice=True),
                one.get_wrapper_attr("add")(1),
            ),
            *(one.unwrapped.color, env.get_attr("number"), one.unwrapped.ran),
            *(hasattr(one, name) for name in ("number", "add", "step", "nothing", "env")),
            *(hasattr(one.unwrapped, name) for name in ("number", "add", "nothing", "env")),
            *(one.has_wrapper_attr("number"), one.has_wrapper_attr("nothing")),
            *(
                env.metadata,
                env.envs[0].metadata,
                one.metadata,
                one.render_mode,
                one.np_random_seed,
                one.np_random,
                one.unwrapped.spec,
            ),
            *(isinstance(one, gym.Env), type(env.envs)),
        ]

    expected, actual = SyncVectorEnv(told(2)), make(told(2))
    assert_same(ask(expected), ask(actual), "answers")


def test_spaces_specs_and_generators_are_themselves(make: Callable[..., Any]) -> None:
    """By ``get_attr``, of one, and in infos; a spec has its facts, and makes nothing."""
    env_fns = [partial(gym.make, "CartPole-v1", max_episode_steps=5 + i) for i in range(2)]
    expected, actual = SyncVectorEnv(env_fns), make(env_fns)
    for env in (expected, actual):
        env.reset(seed=4)
    for name in ("action_space", "observation_space"):
        for i, pair in enumerate(zip(expected.get_attr(name), actual.get_attr(name), strict=True)):
            assert_same_space(*pair, f"{name} {i}")
            assert_same_space(pair[0], getattr(actual.envs[i], name), f"{name} of {i}")
    found = actual.get_attr("spec")
    assert list(map(facts, found)) == list(map(facts, expected.get_attr("spec")))
    assert facts(actual.envs[1].spec) == facts(expected.envs[1].spec)
    with pytest.raises(gym.error.Error, match="in a sandbox"):
        gym.make(found[0])
    assert_same(expected.get_attr("np_random"), actual.get_attr("np_random"), "generators")
    infos = make(told(2)).reset(seed=2)[1]
    assert infos["space"].tolist() == [spaces.Discrete(3, start=-1)] * 2
    assert_same(np.random.default_rng(2).random(), infos["rng"][0].random(), "a draw")


class Spaced(gym.Env[Any, Any]):
    """Has one space under several names, seeds its own, and gets another one."""

    every = spaces.Discrete(70)

    def __init__(self) -> None:
        self.observation_space, self.action_space = spaces.Box(-1, 1, (2,)), spaces.Discrete(50)
        self.by_agent = {"a": spaces.Discrete(90), "b": spaces.Discrete(90)}
        self.several = [self.by_agent["b"], self.every]
        self.graph = spaces.Graph(spaces.Discrete(50), spaces.Discrete(3))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.action_space.seed(seed)
        return np.zeros(2, np.float32), {}

    def of(self, agent: str) -> gym.Space[Any]:
        return self.by_agent[agent]

    def grow(self) -> None:
        self.action_space = spaces.Discrete(99)


def test_a_space_is_one_object_however_it_is_read(make: Callable[..., Any]) -> None:
    """So one ``seed`` holds wherever it is read next, until the environment seeds or replaces it;
    equal spaces that are two objects there are two here."""

    def draws(space: gym.Space[Any]) -> list[Any]:
        return [str(space), *(int(space.sample()) for _ in range(5))]

    def drive(env: Any) -> Iterator[Any]:
        env.reset(seed=1)
        yield draws(env.single_action_space)
        for one in env.envs:
            yield draws(one.unwrapped.action_space)
            one.unwrapped.action_space.seed(3)
            yield [draws(each.action_space) for each in (one, one.env, one.unwrapped)]
            one.unwrapped.by_agent["a"].seed(4)
            one.unwrapped.several[0].seed(5)
            yield [draws(one.unwrapped.of(agent)) for agent in "ab"]
            one.unwrapped.every.seed(6)
            one.unwrapped.graph.seed(7)
            yield one.unwrapped.graph.sample().nodes.tolist()
        yield draws(env.single_action_space), list(map(draws, env.get_attr("every")))
        env.call("of", "a")[0].seed(7)
        yield list(map(draws, env.call("of", "a")))
        env.reset(seed=8)
        yield draws(env.single_action_space)
        yield [draws(one.action_space) for one in env.envs], draws(env.single_action_space)
        env.call("grow")
        yield [str(each.action_space) for one in env.envs for each in (one, one.unwrapped)]

    env_fns = [lambda: gym.wrappers.TimeLimit(Spaced(), 9)] * 2
    assert list(drive(make(env_fns))) == list(drive(SyncVectorEnv(env_fns)))


def test_one_is_not_closed_under_the_others(make: Callable[..., Any]) -> None:
    """Looking at a method runs nothing."""
    env = make(told(2))
    env.reset(seed=0)
    for one in env.envs:
        for name in ("reset", "step", "close", "render", "add"):
            assert callable(getattr(one.unwrapped, name))
    assert env.get_attr("ran") == (["reset"], ["reset"])
    with pytest.raises(ValueError, match="close the vector environment"):
        env.envs[0].close()
    env.step(np.zeros(2, np.int64))
    alone = make(told(1))
    alone.envs[0].close()
    assert alone.get_attr("ran") == (["close"],)


@pytest.mark.parametrize("workers", [1, 2])
def test_async_sub_environments_are_driven_together(workers: int) -> None:
    """They can be read and called one by one, over several processes too, and not stepped."""
    env = vector(told(3), use_async_envs=True, options={"num_workers": workers})
    env.reset(seed=0)
    assert [one.unwrapped.add(5) for one in env.envs] == [5, 6, 7]
    for name in ("step", "reset"):
        with pytest.raises(ValueError, match="AsyncVectorEnv"):
            getattr(env.envs[2], name)()
    assert env.get_attr("ran") == (["reset"],) * 3
    env.close()


def test_a_vector_environment_without_sub_environments_says_so() -> None:
    options = {"env_kwargs": {"subclass": True}}
    env = vector(told(2), use_async_envs=True, shared_memory=False, options=options)
    env.reset(seed=0)
    with pytest.raises(AttributeError, match=r"shows no sub-environments.*get_attr"):
        env.envs[0].number  # noqa: B018
    assert not hasattr(env.envs[0], "number")
    env.step(np.zeros(2, np.int64))
    env.close()


def test_stand_ins_say_what_to_ask_instead() -> None:
    """What has no form of its own is a text, and its AttributeError names the way to its parts. So
    does what stands for the functions, of which there are as many as in ``SyncVectorEnv``."""
    env = vector([partial(Holding, object())] * 2)
    found = env.get_attr("held")[0]
    assert isinstance(found, RemoteObject)
    with pytest.raises(AttributeError, match=r"description of a .*get_attr"):
        found.part  # noqa: B018
    assert len(env.env_fns) == len(SyncVectorEnv(told(2)).env_fns)
    with pytest.raises(gym.error.Error, match="in a sandbox"):
        env.env_fns[0]()
    env.close()


class Holding(Told):
    """Has something that cannot cross."""

    def __init__(self, held: object) -> None:
        super().__init__()
        self.held = object()


@pytest.mark.parametrize("name", [5, None, b"number"])
def test_names_are_strings(name: Any) -> None:
    """As ``getattr`` says it, and the environment can be used on."""
    expected, actual = SyncVectorEnv(told(2)), vector(told(2))
    for ask in (lambda e: e.get_attr(name), lambda e: e.call(name), lambda e: e.set_attr(name, 1)):
        texts = []
        for env in (expected, actual):
            with pytest.raises(TypeError) as info:
                ask(env)
            texts.append(str(info.value))
        assert texts[0] == texts[1]
    actual.reset(seed=0)
    actual.close()

"""What the caller hands in reaches the environment as it would in this process."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox import SandboxVectorEnv, make_env
from envhub_sandbox.errors import EnvHubError, LocalProtocolError
from tests.support.compare import assert_identical
from tests.support.objects import handed

REPOSITORY = """
import cloudpickle
import gymnasium as gym
import numpy as np

class Told(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(3)

    def __init__(self, given):
        self.given = given
        self.action_space = given.get("space", self.action_space)
        self.note = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.options = options
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {"action": repr(action)}

    def again(self, *args, **kwargs):
        # bytes come back as they are; only the tests make something of them
        return cloudpickle.dumps((args, kwargs))

    def kept(self, name):
        return cloudpickle.dumps(getattr(self, name))

class Own(gym.vector.SyncVectorEnv):
    def again(self, *args, **kwargs):
        return cloudpickle.dumps((args, kwargs))

def make_env(n_envs=1, use_async_envs=False, own=False, autoreset_mode="NextStep", **given):
    kind = Own if own else gym.vector.SyncVectorEnv
    return kind([lambda: Told(given)] * n_envs, autoreset_mode=autoreset_mode)
"""


@pytest.fixture(scope="module", autouse=True)
def _by_value() -> Iterator[None]:
    """The tests' own classes travel along, as those of a ``__main__`` do."""
    cloudpickle.register_pickle_by_value(handed)
    yield
    cloudpickle.unregister_pickle_by_value(handed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("told")
    (found / "env.py").write_text(REPOSITORY)
    return found


@pytest.fixture(scope="module")
def env(folder: Path) -> Iterator[SandboxVectorEnv]:
    made = made_of(folder, n_envs=3, num_workers=2)
    made.reset()
    yield made
    made.close()


def made_of(folder: Path, **kwargs: Any) -> SandboxVectorEnv:
    return make_env(folder, **kwargs).env


LARGE = ("long list", "long text", "many bytes")
UNSAID = ("memoryview", "memoryview of numbers", "partial")
VALUES = {
    name: value
    for name, value in (handed.PLAIN | handed.PICKLED).items()
    if name not in (*LARGE, *UNSAID)  # they go the same way, and do not come back so easily
}


def test_a_value_reaches_the_environment_as_it_is(env: SandboxVectorEnv) -> None:
    """As an argument, by position and by name, in every sub-environment."""
    for name, value in VALUES.items():
        for data in env.call("again", value, named=value):
            args, kwargs = cloudpickle.loads(data)
            assert_identical(value, args[0], name)
            assert_identical(value, kwargs["named"], name)


def test_so_do_attributes_and_options(env: SandboxVectorEnv) -> None:
    """``set_attr``, one for all and one each; ``reset``'s options, whatever they are. What comes
    back is inert: a class that went there by value makes nothing here when it returns."""
    for name in ("namedtuple", "OrderedDict", "Fortran order", "StrEnum", "list"):
        value = VALUES[name]
        env.set_attr("note", [value, 1, None])
        for expected, data in zip([value, 1, None], env.call("kept", "note"), strict=True):
            assert_identical(expected, cloudpickle.loads(data), name)
        options = handed.OwnDict(a=value, reset_mask=np.array([True, False, True]))
        env.reset(options=options)
        assert "reset_mask" in options
        for data in env.call("kept", "options")[::2]:
            assert_identical(handed.OwnDict(a=value), cloudpickle.loads(data), name)
    env.set_attr("note", handed.Level.LOW)
    for found in env.get_attr("note"):
        assert type(found).__name__ == "RemoteEnum"


@pytest.mark.parametrize("own", [False, True])
def test_so_do_arguments_of_make_env(folder: Path, own: bool) -> None:
    """In each process that calls it; and a mode of Gymnasium's is one."""
    given = {one.replace(" ", "_"): VALUES[one] for one in ("NamedTuple", "Counter", "dataclass")}
    env = made_of(
        folder,
        n_envs=2,
        num_workers=1 if own else 2,
        env_kwargs={**given, "own": own, "autoreset_mode": gym.vector.AutoresetMode.DISABLED},
    )
    assert env.metadata["autoreset_mode"] is gym.vector.AutoresetMode.DISABLED
    env.reset()
    for data in env.call("kept", "given"):
        assert_identical(given, cloudpickle.loads(data), "given")
    if own:
        args, _ = cloudpickle.loads(env.again(handed.Pose(1.0)))
        assert_identical(handed.Pose(1.0), args[0])
    env.close()


BOX = gym.spaces.Box(-1, 1, (2,))
ACTIONS: dict[str, tuple[gym.Space[Any], Any]] = {
    "ints": (gym.spaces.Discrete(3), [0, 2, 1]),
    "a tuple": (gym.spaces.Discrete(3), (0, 2, 1)),
    "bools": (gym.spaces.Discrete(3), [True, False, True]),
    "numpy's ints": (gym.spaces.Discrete(3), [np.int64(0), np.int64(2), np.int64(1)]),
    "an array": (gym.spaces.Discrete(3), np.array([0, 2, 1])),
    "lists of floats": (BOX, [[0.1, 1.0], [0.0, -0.0], [0.5, 0.25]]),
    "lists of ints": (BOX, [[0, 1], [1, 0], [1, 1]]),
    "arrays": (BOX, list(np.ones((3, 2), np.float32))),
    "multi": (gym.spaces.MultiDiscrete([2, 3]), [[0, 1], [1, 0], [1, 2]]),
    "in a dict": (
        gym.spaces.Dict({"a": gym.spaces.Discrete(3), "b": BOX}),
        {"a": [0, 1, 2], "b": np.ones((3, 2), np.float32)},
    ),
}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {"num_workers": 2}) for name in ACTIONS),
        *(
            ("in a dict", options)
            for options in ({}, {"policy": {"lane": "frames"}, "num_workers": 2})
        ),
    ],
)
def test_an_action_reaches_the_environment_as_it_is(
    folder: Path, name: str, options: dict[str, Any]
) -> None:
    """A list of Python's numbers as such; what follows it as what that is."""
    space, actions = ACTIONS[name]
    told: dict[str, Any] = {}
    exec(REPOSITORY, told)
    reference = told["make_env"](3, space=space)
    env = made_of(folder, n_envs=3, env_kwargs={"space": space}, **options)
    reference.reset(seed=1)
    env.reset(seed=1)
    for asked in (actions, env.action_space.sample(), actions):
        expected, found = reference.step(asked)[4], env.step(asked)[4]
        assert found["action"].tolist() == expected["action"].tolist()
    env.close()


def test_what_cannot_be_sent_says_which_it_is(env: SandboxVectorEnv, folder: Path) -> None:
    """By its place in the caller's arguments, whatever the shards are; and nothing has happened."""
    lock = threading.Lock()
    with pytest.raises(LocalProtocolError, match=r"set_attr\('note'\): values\[2\] cannot be sent"):
        env.set_attr("note", [1, 2, lock])
    with pytest.raises(LocalProtocolError, match=r"call\('again'\): kwargs\['a'\]\['b'\] cannot"):
        env.call("again", a={"b": lock})
    with pytest.raises(LocalProtocolError, match=r"reset: options\['a'\] cannot be sent"):
        env.reset(options={"a": lock})
    assert len(env.call("again")) == 3
    with pytest.raises(EnvHubError, match=r"env_kwargs\['camera'\]\['pose'\] cannot be sent"):
        make_env(folder, env_kwargs={"camera": {"pose": lock}})


def test_a_class_that_is_not_to_be_had_there_says_what_to_do(
    env: SandboxVectorEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module of the caller's own is not in the sandbox; its classes can travel along."""
    (tmp_path / "my_own_config.py").write_text("class Config:\n    size = 3\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import my_own_config

    with pytest.raises(EnvHubError, match="register_pickle_by_value\\(my_own_config\\)"):
        env.call("again", my_own_config.Config())
    cloudpickle.register_pickle_by_value(my_own_config)
    try:
        assert len(env.call("again", my_own_config.Config())) == 3
    finally:
        cloudpickle.unregister_pickle_by_value(my_own_config)
        del sys.modules["my_own_config"]


def test_a_known_manifest_serves_again(folder: Path) -> None:
    """For arguments that only pickle carries, if no code of the caller's own is named in them."""
    lasting = {"a": VALUES["OrderedDict"], "b": VALUES["AutoresetMode"], "c": VALUES["big-endian"]}
    for given, known in ((lasting, True), ({"a": VALUES["NamedTuple"]}, False)):
        make_env(folder, env_kwargs=given).close()
        again = made_of(folder, env_kwargs=given)
        assert bool(again.sandbox.report()) is not known  # it runs, where it has to be asked
        again.close()

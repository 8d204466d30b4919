"""What a sub-environment warns of reaches the caller as it does from ``SyncVectorEnv``."""

import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from envhub_sandbox.errors import RemoteEnvWarning
from tests.compliance.theirs.through_sandbox import vector

WAYS: dict[str, dict[str, Any]] = {
    "sync": {},
    "subclass": {"options": {"env_kwargs": {"subclass": True}}},
    "frames": {"options": {"policy": {"lane": "frames"}}},
    "workers": {"use_async_envs": True, "options": {"num_workers": 2}},
}
_COLORS = re.compile("\x1b\\[[0-9;]*m")


class Own(RuntimeWarning):
    """A category that the caller does not have."""


class Warner(gym.Env[Any, Any]):
    """Warns of whatever it does."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(6)

    def __init__(self) -> None:
        warnings.warn("built", stacklevel=1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        gym.logger.warn("reset %s", options)
        return np.zeros(2, np.float32), {"n": 1}

    def step(self, action: Any) -> Any:
        if action == 1:
            warnings.warn("one", Own, stacklevel=1)
        if action == 2:
            warnings.warn("hidden by default", DeprecationWarning, stacklevel=1)
        if action in (3, 4):
            for number in range(20):
                warnings.warn(f"many {number}", stacklevel=1)
        if action == 4:
            raise ValueError("after its warnings")
        info = {"text": "x" * 100_000} if action == 5 else {"n": 1} if action else {}
        return np.full(2, action, np.float32), float(action), False, False, info

    def told(self) -> int:
        warnings.warn("called", stacklevel=1)
        return 1


@contextmanager
def listening() -> Iterator[list[tuple[str, str]]]:
    """What is warned of, as Python shows it by default: the category's name, and the text."""
    told: list[tuple[str, str]] = []

    def show(message: Any, category: type, *_: Any) -> None:
        if isinstance(message, RemoteEnvWarning):
            told.append((message.category.rpartition(".")[2], message.text))
        else:
            told.append((category.__name__, _COLORS.sub("", str(message))))

    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        warnings.resetwarnings()
        warnings.simplefilter("ignore", DeprecationWarning)
        patch.setattr(warnings, "showwarning", show)
        yield told


def heard(make: Any) -> list[Any]:
    """What each call warned of, and what came of it."""
    with listening() as told:
        env = make([Warner] * 2)
        found: list[Any] = [sorted(env.reset()[1])]
        said = [sorted(told)]
        for actions in ([0, 0], [0, 1], [1, 0], [2, 2], [3, 3], [0, 3], [0, 5], [0, 0]):
            told.clear()
            result = env.step(np.array(actions))
            found.append([result[0].tolist(), result[1].tolist(), sorted(result[4])])
            said.append(sorted(told))
        told.clear()
        found.append(env.call("told"))
        said.append(sorted(told))
        env.close()
    return [found, said]


@pytest.mark.parametrize("way", WAYS)
def test_warnings_arrive_with_what_they_came_with(way: str) -> None:
    """Once each, of however many sub-environments; results are as without them."""
    found, said = heard(lambda env_fns: vector(env_fns, **WAYS[way]))
    expected = heard(SyncVectorEnv)
    assert found == expected[0]
    # twenty do not fit one answer: some come with the next
    assert [one for some in said for one in some if "many" not in one[1]] == [
        one for some in expected[1] for one in some if "many" not in one[1]
    ]
    assert sorted(chain.from_iterable(said)) == sorted(chain.from_iterable(expected[1]))
    assert said[0] == [("UserWarning", "WARN: reset None"), ("UserWarning", "built")]


@pytest.mark.parametrize("way", ["sync", "frames", "workers"])
def test_what_warns_before_it_fails_says_both(way: str) -> None:
    env = vector([Warner] * 2, **WAYS[way])
    with listening() as told:
        env.reset()
        told.clear()
        with pytest.raises(ValueError, match="after its warnings"):
            env.step(np.array([4, 4]))
        assert ("UserWarning", "many 0") in told
        env.step(np.array([0, 0]))
    env.close()
    assert sorted(told) == sorted(("UserWarning", f"many {number}") for number in range(20))


@pytest.mark.parametrize("way", ["sync", "frames", "workers"])
def test_a_filter_may_make_an_error_of_it(way: str) -> None:
    """It comes out of the call, is nobody's fault, and the environment goes on."""
    env = vector([Warner] * 2, **WAYS[way])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.reset()
        warnings.simplefilter("error")
        with pytest.raises(RemoteEnvWarning, match=r"Own: one$"):
            env.step(np.array([1, 0]))
        assert env.step(np.array([1, 0]))[0].tolist() == [[1, 1], [0, 0]]
    assert env.sandbox.stats()["state"] == "READY"
    env.close()


class Raising(Warner):
    """Fails to close."""

    def close(self) -> None:
        """Raise."""
        raise ValueError("not saved")


class Hanging(Warner):
    """Never ends its close."""

    def close(self) -> None:
        """Wait for what never comes."""
        threading.Event().wait()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("env_fn", "text"),
    [(Raising, "its close raised ValueError: not saved"), (Hanging, "close was ended after 0.5 s")],
)
def test_a_close_that_fails_is_told(way: str, env_fn: Any, text: str) -> None:
    close_s = 0.5 if env_fn is Hanging else 60.0
    options = {**WAYS[way].get("options", {}), "timeouts": {"close_s": close_s}}
    env = vector([env_fn] * 2, **{**WAYS[way], "options": options})
    with listening() as told:
        env.reset()
        told.clear()
        env.close()
        env.close()
    assert [category for category, _ in told] == ["RuntimeWarning"]
    assert text in told[0][1]

"""Repositories on ``gym``, Gymnasium's predecessor, compared with the same stepped by hand.
The oracle is a plain process that has the same packages, and uses ``gym`` as its users did."""

import json
import subprocess
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvWarning
from envhub_worker.protocol.runtime import Runtime
from tests.support.packages.environments import installed_once, running_on
from tests.support.samples import SAMPLES

REPOSITORY = SAMPLES / "old_gym"
STEPS = 60
NEWEST = ("gym==0.26.2", "gymnasium", "numpy==1.26.4")
OLDER = ("gym==0.23.1", "gymnasium", "numpy==1.26.4")
NEWEST_NUMPY = ("gym==0.26.2", "gymnasium", "numpy>=2")
CASES = [(OLDER, "wrapped"), (NEWEST, "walk"), (NEWEST, "cartpole")]
BY_HAND = """
import json, sys
sys.path[:0] = sys.argv[1:3]
import numpy as np
from env import MAKERS
kind, seed, actions = json.loads(sys.argv[3])
env = MAKERS[kind]()

def plain(value):
    if isinstance(value, dict):
        return {key: plain(value[key]) for key in sorted(value)}
    if isinstance(value, tuple):
        return [plain(one) for one in value]
    return [str(np.asarray(value).dtype), np.asarray(value).tobytes().hex()]

def action(given):
    if isinstance(given, dict):
        return {"turn": np.int64(given["turn"]), "push": np.array(given["push"], np.float32)}
    return np.int64(given)

def reset(seed=None):
    if kind == "cartpole":
        return env.reset(seed=seed)[0]
    if seed is not None:
        env.seed(seed)
    return env.reset()

found, over = [plain(reset(seed))], False
for given in actions:
    if over:
        found.append([plain(reset()), 0.0, False, False])
        over = False
        continue
    observation, reward, *done, info = env.step(action(given))
    if len(done) == 1:
        cut = info.get("TimeLimit.truncated", False)
        done = [done[0] and not cut, done[0] and cut]
    found.append([plain(observation), float(reward), *map(bool, done)])
    over = any(done)
json.dump(found, sys.stdout)
"""


@pytest.fixture(scope="module")
def runtimes() -> Iterator[Any]:
    # gym has no wheels: its releases are a source distribution of pure Python
    with installed_once("gym") as runtime:
        yield runtime


def by_hand(runtime: Runtime, kind: str, seed: int, actions: list[Any]) -> Any:
    """What the environment gives to those who use ``gym``."""
    task = json.dumps([kind, seed, actions])
    options = ["-B", "-W", "ignore"]  # another test may be reading this folder as a repository
    command = [runtime.python, *options, "-c", BY_HAND, str(REPOSITORY), runtime.packages]
    done = subprocess.run([*command, task], capture_output=True, text=True, timeout=300)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout)


def sandboxed(runtime: Runtime, seed: int, actions: list[Any], **options: Any) -> Any:
    """The same of the first of two sub-environments, and the warnings that came."""
    kwargs = {"kind": options.pop("kind"), "around": options.pop("around", "nothing")}
    with running_on(runtime), warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with make_env(str(REPOSITORY), n_envs=2, env_kwargs=kwargs, **options) as suites:
            env = suites.env
            found: list[Any] = [plain(env.reset(seed=seed)[0])]
            for action in actions:
                observation, reward, *done, _ = env.step(batch(action))
                flags = [bool(one[0]) for one in done]
                found.append([plain(observation), float(reward[0]), *flags])
    return found, [one for one in told if issubclass(one.category, RemoteEnvWarning)]


def plain(observation: Any) -> Any:
    """The first row, as the other process writes it."""
    if isinstance(observation, dict):
        return {key: plain(observation[key]) for key in sorted(observation)}
    if isinstance(observation, tuple):
        return [plain(one) for one in observation]
    return [str(observation.dtype), observation[0].tobytes().hex()]


def batch(action: Any) -> Any:
    if isinstance(action, dict):
        turn, push = action["turn"], action["push"]
        return {"push": np.array([push, push], np.float32), "turn": np.array([turn, turn])}
    return np.array([action, action])


def some_actions(kind: str) -> list[Any]:
    random = np.random.default_rng(7)
    if kind == "cartpole":
        return [int(one) for one in random.integers(0, 2, STEPS)]
    turns, pushes = random.integers(0, 3, STEPS), random.uniform(-1, 1, (STEPS, 2))
    return [
        {"turn": int(turn), "push": [float(np.float32(one)) for one in push]}
        for turn, push in zip(turns, pushes, strict=True)
    ]


@pytest.mark.parametrize(("requirements", "kind"), CASES)
def test_it_is_bit_for_bit_what_a_user_of_gym_has(
    requirements: tuple[str, ...], kind: str, runtimes: Any
) -> None:
    """By either way to seed it, and with four results or five; and it says once that it is old."""
    runtime, actions = runtimes(requirements), some_actions(kind)
    expected = by_hand(runtime, kind, 5, actions)
    assert any(one[2] or one[3] for one in expected[1:])
    assert by_hand(runtime, kind, 6, actions) != expected
    found, told = sandboxed(runtime, 5, actions, kind=kind)
    assert found == expected
    if kind == "wrapped":  # twelve steps, unless the environment ends the episode itself
        assert any(truncated for *_, truncated in found[1:])
        assert any(terminated for _, _, terminated, _ in found[1:])
    release = requirements[0].partition("==")[2]
    assert [f"gym {release}, which is not maintained" in str(one.message) for one in told].count(
        True
    ) == 1


def test_code_of_gym_has_what_numpy_took_away(runtimes: Any) -> None:
    runtime, actions = runtimes(NEWEST_NUMPY), some_actions("cartpole")
    for kind, name in (("cartpole", "bool8"), ("old_names", "int")):
        with pytest.raises(RuntimeError, match=f"attribute '{name}'"):
            by_hand(runtime, kind, 5, actions)
    expected = by_hand(runtimes(NEWEST), "cartpole", 5, actions)
    assert sandboxed(runtime, 5, actions, kind="old_names")[0] == expected


def test_vectors_of_gym_reset_in_the_step_that_ends(runtimes: Any) -> None:
    """As ``SAME_STEP`` says, with the last observation in the infos."""
    actions = some_actions("cartpole")
    expected = by_hand(runtimes(NEWEST), "cartpole", 5, actions)
    last = next(index for index, one in enumerate(expected[1:]) if one[2] or one[3])
    with (
        running_on(runtimes(NEWEST)),
        warnings.catch_warnings(),
        make_env(
            str(REPOSITORY),
            n_envs=2,
            use_async_envs=True,
            env_kwargs={"kind": "cartpole", "around": "gym"},
        ) as suites,
    ):
        warnings.simplefilter("ignore")
        env = suites.env
        assert env.metadata["autoreset_mode"].value == "SameStep"
        assert plain(env.reset(seed=5)[0]) == expected[0]
        for number, action in enumerate(actions[: last + 1]):
            observation, *_, infos = env.step(batch(action))
            final = infos.get("final_obs", [None])[0]
            row = observation if number < last else np.asarray([final])
            assert plain(row) == expected[number + 1][0]


def test_gyms_in_a_vector_of_gymnasium(runtimes: Any) -> None:
    """Gymnasium itself refuses them; here they are what they are without it."""
    actions = some_actions("walk")
    expected = by_hand(runtimes(NEWEST), "walk", 5, actions)
    found, _ = sandboxed(runtimes(NEWEST), 5, actions, kind="walk", around="gymnasium")
    assert found == expected


def test_its_attributes_methods_and_frames(runtimes: Any) -> None:
    """An attribute that was set is the environment's own, below every wrapper."""
    with (
        running_on(runtimes(OLDER)),
        warnings.catch_warnings(),
        make_env(str(REPOSITORY), n_envs=2, env_kwargs={"kind": "wrapped"}) as suites,
    ):
        warnings.simplefilter("ignore")
        env = suites.env
        assert (env.metadata["render_fps"], env.render_mode) == (20, "rgb_array")
        env.reset(seed=1)
        first = env.call("distance", scale=2)
        env.set_attr("gain", 0.0)
        assert env.get_attr("gain") == (0.0, 0.0)
        env.step(batch(some_actions("walk")[0]))
        assert env.call("distance", scale=2) == first
        assert [frame.tolist() for frame in env.render()] == [np.ones((4, 4, 3)).tolist()] * 2

"""What an environment returns and no batch can hold is told with its call, space and line."""

import traceback
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from envhub_worker.runner.returned import misfit_in_vector
from envhub_worker.runner.sync_envs import SubEnvs

BOX = spaces.Box(-10, 10, (4,), np.float32)
SEEN = np.zeros(4, np.float32)
NESTED = spaces.Dict({"near": BOX, "pair": spaces.Tuple((BOX, spaces.Discrete(3)))})


class Returning(gym.Env[Any, Any]):
    """Returns what it was made with."""

    action_space = spaces.Discrete(2)

    def __init__(self, space: Any, first: Any, *later: Any, info: Any = None) -> None:
        self.observation_space = space
        self.first, self.later, self.info = first, later, {} if info is None else info

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return self.first, {}  # first

    def step(self, action: Any) -> Any:
        if action == 2:
            return SEEN, 0.0, True, False, {}
        return (*self.later, self.info)  # later


class Growing(Returning):
    """Has another space from its first reset on."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.observation_space = spaces.Box(-1, 1, (6,), np.float32)
        return np.zeros(6, np.float32), {}  # grown


class Plain(gym.Wrapper[Any, Any, Any, Any]):
    """Passes everything on, without a line of its own."""


def whole(observation: Any = SEEN, reward: Any = 0.0, *flags: Any) -> tuple[Any, ...]:
    return (observation, reward, *(flags or (False, False)))


AGENTS = {"agent_0": SEEN, "agent_1": SEEN}
KINDS: dict[str, tuple[Any, Any, tuple[Any, ...], Any, str, str]] = {
    "another shape": (BOX, SEEN, whole(np.zeros(14, np.float32)), None, "later",
        "step of sub-environment 0 returned float32 (14,), its observation_space is Box(-10.0"),
    "another kind": (spaces.Box(0, 1, (4,), np.int64), SEEN, whole(), None, "first",
        "reset of sub-environment 0 returned float32 (4,), its observation_space is Box(0, 1"),
    "a fraction": (spaces.Discrete(3), 0.5, whole(), None, "first",
        "reset of sub-environment 0 returned float 0.5, its observation_space is Discrete(3)"),
    "the space": (BOX, BOX, whole(), None, "first",
        "reset of sub-environment 0 returned the space Box(-10.0, 10.0, (4,), float32), its"),
    "nothing": (BOX, SEEN, whole(None), None, "later",
        "step of sub-environment 0 returned None, its observation_space is Box(-10.0"),
    "the info in its place": (BOX, SEEN, whole({}), None, "later",
        "step of sub-environment 0 returned an empty dict, its observation_space is Box(-10.0"),
    "agents": (BOX, SEEN, whole(AGENTS), None, "later",
        "returned dict with 'agent_0', 'agent_1', its observation_space is Box(-10.0"),
    "a key too few": (NESTED, {"near": SEEN}, whole(), None, "first",
        "returned dict with 'near' without 'pair', its observation_space is Dict("),
    "a part": (NESTED, {"near": SEEN, "pair": (SEEN[:2], 0)}, whole(), None, "first",
        "returned float32 (2,) as observation['pair'][0], its observation_space['pair'][0] is"),
    "a part beside a text": (spaces.Dict({"near": BOX, "said": spaces.Text(9)}),
        {"near": SEEN[:1], "said": "no"}, whole(), None, "first",
        "returned float32 (1,) as observation['near'], its observation_space['near'] is Box("),
    "a reward in an array": (BOX, SEEN, whole(SEEN, np.zeros(3)), None, "later",
        "step of sub-environment 0 returned float64 (3,) as reward. A vector environment"),
    "agents' rewards": (BOX, SEEN, whole(SEEN, {"agent_0": 1.0}), None, "later",
        "step of sub-environment 0 returned dict with 'agent_0' as reward. A vector environment"),
    "an end of each": (BOX, SEEN, whole(SEEN, 0.0, np.zeros(2, bool), False), None, "later",
        "step of sub-environment 0 returned bool (2,) as terminated, which has to be one bool"),
    "a list of infos": (BOX, SEEN, whole(), [1], "later",
        "step of sub-environment 0 returned list [1] as info, which has to be a dict"),
    "no infos": (BOX, SEEN, whole(), (), "later",
        "step of sub-environment 0 returned tuple () as info, which has to be a dict"),
}  # fmt: skip


def raised(env: Any, *errors: type[Exception]) -> Exception:
    with pytest.raises(errors) as caught:
        play(env)
    return caught.value


def play(env: Any) -> None:
    if isinstance(env, SubEnvs):
        env.run_reset([0], None, None)
        env.run_step(np.array([0]))
    else:
        env.reset(seed=[0])
        env.step(np.array([0]))


def last_line(error: Exception) -> str:
    line = traceback.extract_tb(error.__traceback__)[-1].line
    return str(line).partition("#")[2].strip()


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_told_with_its_call_and_its_line(kind: str) -> None:
    """Also below a wrapper that only passes it on. The control: Gymnasium has no room for it."""
    space, first, later, info, line, text = KINDS[kind]

    def make() -> Any:
        return Plain(Returning(space, first, *later, info=info))

    error = raised(SubEnvs([make], "NextStep", sync=True), TypeError, ValueError)
    assert text in str(error)
    assert last_line(error) == line
    theirs = SyncVectorEnv([make])
    refused = raised(theirs, AttributeError, IndexError, KeyError, TypeError, ValueError)
    if "observation" in text:
        told = misfit_in_vector(refused, theirs, "step")
        assert text.partition("returned")[2] in str(told)


def test_a_space_that_changes_is_told() -> None:
    env = SubEnvs([lambda: Growing(BOX, SEEN, *whole())], "NextStep", sync=True)
    error = raised(env, ValueError)
    text = (
        "returned float32 (6,), its observation_space is Box(-10.0, 10.0, (4,), float32), and has"
    )
    assert f"{text} become Box(-1.0, 1.0, (6,), float32)" in str(error)
    assert last_line(error) == "grown"


@pytest.mark.parametrize(
    ("seen", "later"),
    [
        (np.zeros(4), whole(np.zeros(4, np.float16), np.float32(1.0))),
        ([0, 1, 2, 3], whole((1, 2, 3, 4), True, np.bool_(True), 0)),
        (np.zeros(4, np.int8), whole(SEEN, np.array(2.0), np.array([True]), None)),
    ],
)
def test_what_gymnasium_accepts_is_not_refused(seen: Any, later: Any) -> None:
    def make() -> Any:
        return Returning(BOX, seen, *later)

    ours, theirs = SubEnvs([make], "NextStep", sync=True), SyncVectorEnv([make])
    ours.run_reset([0], None, None)
    assert (ours.batch.observation() == theirs.reset(seed=0)[0]).all()
    ours.run_step(np.array([0]))
    batch, (seen, *numbers, _) = ours.batch, theirs.step(np.array([0]))
    each = zip([batch.rewards, batch.terminations, batch.truncations], numbers, strict=True)
    assert batch.observation().tobytes() == seen.tobytes()
    assert all(one.tobytes() == other.tobytes() for one, other in each)


def test_what_gymnasiums_checker_refuses_leads_to_the_method() -> None:
    """It is in environments of ``gymnasium.make``, and looks at what has been returned."""
    checked = gym.wrappers.PassiveEnvChecker
    env = SubEnvs([lambda: checked(Returning(BOX, SEEN, *whole(), info=[1]))], "NextStep", True)
    frames = traceback.extract_tb(raised(env, AssertionError).__traceback__)
    assert [one.name for one in frames if one.filename == __file__][-1] == "step"

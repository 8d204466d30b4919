"""What a play notices, of an environment that does what a script says."""

import itertools
import tracemalloc
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_sandbox.extras.judge.play.members import OutsideSpaceError, check_observations, holds
from envhub_sandbox.extras.judge.play.traces import Trace, digest, play
from envhub_worker.protocol.spaces.spaces import OpaqueSpace
from tests.support import inside

_MORE = (0.0, False)
_END = (0.0, True)
_TIMES = itertools.count()


class _Scripted:
    """One sub-environment: ``begun`` are the observations of its resets; steps are a reward, and
    whether they end it."""

    num_envs = 1
    single_observation_space = spaces.Box(-np.inf, np.inf, (), np.float64)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __init__(self, begun: Sequence[float], steps: Sequence[tuple[float, bool]]) -> None:
        self.action_space = spaces.MultiDiscrete([2])
        self._begun, self._steps = iter(begun), iter(steps)

    def reset(self, **_: Any) -> Any:
        return np.array([next(self._begun)]), {}

    def step(self, _: Any) -> Any:
        reward, ended = next(self._steps)
        infos = {"took": np.array([next(_TIMES)])}  # which no two plays have in common
        return np.zeros(1), np.array([reward]), np.array([ended]), np.zeros(1, bool), infos


def played(mode: str, begun: Sequence[float], *steps: tuple[float, bool]) -> Trace:
    env: Any = _Scripted(begun, steps)
    return play(env, mode, seed=0, steps=len(steps))


@pytest.mark.parametrize(
    ("after", "noted"), [(_MORE, False), ((1.0, False), True), (_END, True), ((1.0, True), True)]
)
def test_a_step_that_resets_gives_and_ends_nothing(after: tuple[float, bool], noted: bool) -> None:
    """The control is the mode in which there is no such step."""
    assert bool(played("NextStep", [0.0], _END, after).notes["autoreset"]) is noted
    assert not played("Disabled", [0.0, 0.0], _END, after).notes["autoreset"]


def test_what_a_reset_between_gives_is_compared() -> None:
    """Of who has to reset it himself; the step after it is the same."""
    first = played("Disabled", [0.0, 1.0], _MORE, _END, _MORE)
    assert first.differs_from(played("Disabled", [0.0, 1.0], _MORE, _END, _MORE)) is None
    assert first.differs_from(played("Disabled", [0.0, 2.0], _MORE, _END, _MORE)) == 3


def traced(seen: Any, rewards: Sequence[float] = (0.0, 0.0)) -> Trace:
    trace = Trace()
    trace.add([seen])
    trace.add([seen, np.array(rewards), np.zeros(2, bool), np.zeros(2, bool)])
    return trace


@pytest.mark.parametrize(
    ("one", "other", "at", "words"),
    [
        ((np.zeros((2, 3)),), (np.eye(3)[1:],), 0,
            "the observation[1] of sub-environment 0 is 0.0 and 1.0"),
        ((np.zeros(2), (0.5, 0.25)), (np.zeros(2), (0.5, 1.0)), 1,
            "the reward of sub-environment 1 is 0.25 and 1.0"),
        (({"a": np.zeros(2), "b": ("x", "y")},), ({"a": np.zeros(2), "b": ("x", "z")},), 0,
            "the observation['b'][1] is str 'y' and str 'z'"),
        ((np.zeros(2, np.float32),), (np.zeros(2),), 0,
            "the observation is float32 (2,) and float64 (2,)"),
        ((np.zeros(33 << 20, np.int8),), (np.ones(33 << 20, np.int8),), 0, ""),
    ],
    ids=["row", "reward", "text", "dtype", "too large to be kept"],
)  # fmt: skip
def test_what_differs_has_its_row_and_values(one: Any, other: Any, at: int, words: str) -> None:
    """Of results that are kept; that they differ is told of all."""
    first, second = traced(*one), traced(*other)
    assert first.differs_from(second) == at
    told = first.difference(second, at)
    assert told.startswith(f": {words}") if words else told == ""
    assert first.difference(traced(*one), at) == "", "the control"


@pytest.mark.parametrize("wide", [True, False], ids=["long name", "many parts"])
def test_what_is_kept_of_results_is_bounded(wide: bool) -> None:
    """By names as by values; a worker chooses how long the one and how many the others are."""
    parts: Any = {str(number): np.zeros(1) for number in range(300 if wide else 1000)}
    trace = inside.small_trace()
    tracemalloc.start()
    try:
        for _ in range(12):
            trace.add([{"k" * 5_000: parts} if wide else parts])
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 3 << 19
    assert trace.results, "the control: something is kept"


_BOTH = np.ones(2, bool)


@pytest.mark.parametrize(
    ("infos", "wrong"),
    [
        ({"at": np.zeros(2), "_at": _BOTH}, ""),
        ({"at": np.zeros(3)}, ""),  # about all of them
        ({"_at": np.zeros(3)}, ""),
        ({"at": np.zeros(3), "_at": _BOTH}, "'at' is (3,)"),
        ({"at": np.zeros(2), "_at": np.ones(3, bool)}, "'_at' is bool (3,)"),
        ({"at": np.zeros(2), "_at": np.ones(2)}, "'_at' is float64 (2,)"),
        ({"of": {"at": np.zeros(2), "_at": _BOTH}, "_of": _BOTH}, ""),
        ({"of": {"at": np.zeros(3), "_at": _BOTH}, "_of": _BOTH}, "'at' is (3,)"),
    ],
)
def test_masks_are_of_all_sub_environments(infos: dict[str, Any], wrong: str) -> None:
    assert [*inside.wrong_masks(infos, 2)] == ([f"{wrong}, of 2 sub-environments"] if wrong else [])


def test_the_last_observations_are_no_large_infos() -> None:
    last = {name: np.zeros(1000) for name in ("final_obs", "final_observation")}
    assert inside.info_bytes({"at": np.zeros(2), "of": {"text": "four"}, **last}) == 20


_SAME = [
    ({"a": 1, "b": 2.0}, {"b": 2.0, "a": 1}),
    ((1, "x"), [1, "x"]),
    (np.array(["x", None], object), ["x", None]),
    (np.zeros((4, 4))[::2], np.zeros((2, 4))),
    (float("nan"), float("nan")),
]
_OTHER = [
    (np.zeros(2, np.float32), np.zeros(1, np.float64)),
    (np.zeros(2, np.float32), np.zeros(2, np.int32)),
    (np.zeros((1, 2)), np.zeros((2, 1))),
    (0.0, -0.0),
    (np.zeros(1), -np.zeros(1)),
    (1, True),
    ("1", 1),
    ({"a": 1}, {"b": 1}),
    ({}, []),
    ([[], 1], [[1]]),
]


@pytest.mark.parametrize(("one", "two"), _SAME)
def test_a_digest_is_of_values(one: Any, two: Any) -> None:
    assert digest(one) == digest(two)


@pytest.mark.parametrize(("one", "two"), _OTHER)
def test_other_values_have_another_digest(one: Any, two: Any) -> None:
    assert digest(one) != digest(two)


def test_a_member_of_another_dtype_counts_by_its_value() -> None:
    """Not by its dtype, as ``contains`` does."""
    box = spaces.Box(0, 1, (2,), np.float32)
    nested = spaces.Dict(a=spaces.Tuple([box, spaces.Discrete(3)]))
    good = {"a": (np.array([0.0, 1.0]), np.int64(2))}
    assert holds(nested, good)
    assert not holds(nested, {"a": (good["a"][0], np.int64(3))})
    assert not holds(nested, {"a": good["a"][:1]})
    assert not holds(nested, {"b": good["a"]})
    assert not holds(box, np.array(["0", "1"]))
    assert holds(OpaqueSpace("their.Space", "Space()"), object())


@pytest.mark.parametrize(
    ("values", "final", "error"),
    [
        ([0.0, 0.5], None, None),
        ([0.0, 0.5], np.array([None, 0.5], object), None),
        ([0.0, 2.0], None, "sub-environment 1 gave"),
        ([0.0, np.nan], None, "sub-environment 1 gave"),
        ([0.0, 0.5], np.array([2.0, None], object), "the last step .* sub-environment 0 gave"),
        (None, None, "no batch of observations"),
    ],
)
@pytest.mark.parametrize("own", [False, True], ids=["batch", "own"])
def test_an_observation_outside_its_space_ends_the_play(
    values: Any, final: Any, error: str | None, own: bool
) -> None:
    """A space that is no batch of the single one decides for the whole batch."""
    single = spaces.Box(0, 1, (), np.float32)
    batched = spaces.Box(0, 1, (1, 2), np.float32) if own else batch_space(single, 2)
    env = SimpleNamespace(num_envs=2, single_observation_space=single, observation_space=batched)
    batch = None if values is None else np.array([values] if own else values, np.float32)
    if error is None:
        check_observations(env, "step", batch, final)
        return
    whole = own and final is None
    with pytest.raises(OutsideSpaceError, match="sub-environment 0 gave" if whole else error):
        check_observations(env, "step", batch, final)

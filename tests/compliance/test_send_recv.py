"""``send`` and ``recv`` give each sub-environment what it gives alone, whatever others do."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from envhub_sandbox import make_env
from tests.compliance.pair import Pair
from tests.compliance.vector_env import MODES, Case, VectorEnvCompliance, paired
from tests.support.compare import assert_same
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample


def _sent_in_pieces(env: Any, rng: Any) -> Any:
    """A step as it is made of sends, to workers in any order, and one receipt of all."""
    workers = [range(*worker["rows"]) for worker in env.sandbox.stats()["workers"]]

    def step(actions: Any) -> Any:
        left = [workers[index] for index in rng.permutation(len(workers))]
        while left:
            some = [left.pop() for _ in range(int(rng.integers(1, len(left) + 1)))]
            ids = rng.permutation([index for rows in some for index in rows])
            env.send(actions[ids], ids if len(ids) < env.num_envs else ids.tolist())
        *results, env_ids = env.recv(env.num_envs)
        assert env_ids.tolist() == list(range(env.num_envs))
        return tuple(results)

    return step


@pytest.fixture(scope="class")
def pair(request: pytest.FixtureRequest, case: Case, lane: str) -> Iterator[Pair]:
    """The reference, and an environment whose steps are sent and received."""
    with paired(request.cls.sample, case, policy={"lane": lane}, min_ready=1) as both:
        both.sandboxed.step = _sent_in_pieces(both.sandboxed, np.random.default_rng(0))
        yield both


def _cases(n_envs: int, workers: int | None, modes: tuple[str, ...] = MODES) -> list[Case]:
    return [Case(n_envs, False, {"autoreset_mode": mode}, workers) for mode in modes]


class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos; five rows, three workers."""

    sample = "counter"
    cases = _cases(5, 3)
    steps = 80


class TestCartPole(VectorEnvCompliance):
    """A worker for each."""

    sample = "cartpole"
    cases = _cases(3, None, ("SameStep",))
    steps = 300


# how long each step takes is drawn from a generator that no result depends on
_DELAYED = """
import sys, time
sys.path.insert(0, ".")
import gymnasium as gym
import numpy as np
from counter import Counter

class Delayed(Counter):
    def step(self, action):
        time.sleep(np.random.default_rng().exponential(0.002))
        return super().step(action)

def make_env(n_envs=1, use_async_envs=False, autoreset_mode="NextStep"):
    mode = gym.vector.AutoresetMode(autoreset_mode)
    kinds = [lambda i=i: Delayed(i) for i in range(n_envs)]
    return gym.vector.SyncVectorEnv(kinds, autoreset_mode=mode)
"""
_STEPS = 60


def _alone(folder: Path, index: int, mode: str, actions: Any) -> list[Any]:
    """What the same sub-environment gives in this process, where nothing else is."""
    namespace: dict[str, Any] = {"__name__": "counter"}
    exec((folder / "counter.py").read_text(), namespace)
    kind = namespace["Counter"]
    env = SyncVectorEnv([lambda: kind(index)], autoreset_mode=AutoresetMode(mode))
    env.reset(seed=100 + index)
    taken = []
    for action in actions:
        taken.append(env.step(np.array([action])))
        done = np.logical_or(*taken[-1][2:4])
        if mode == "Disabled" and done.any():
            env.reset(options={"reset_mask": done})
    return taken


def _row(received: Any, place: int) -> Any:
    rows = [column[place : place + 1] for column in received[:4]]
    return (*rows, _own(received.infos, place))


def _own(infos: dict[str, Any], place: int) -> dict[str, Any]:
    own = {}
    for key, value in infos.items():
        if isinstance(value, dict):
            inner = _own(value, place)
            if infos[f"_{key}"][place]:
                own[key] = inner
        elif not key.startswith("_") and infos[f"_{key}"][place]:
            own[key] = value[place].tolist() if hasattr(value[place], "tolist") else value[place]
    return dict(sorted(own.items()))  # in a batch of several, the first has the first say


# who resets by itself sends no actions ahead, and has a worker for each
_WAYS: list[tuple[str, int | None, int, str]] = [
    ("Disabled", None, 1, "auto"),
    ("Disabled", None, 1, "frames"),
    ("NextStep", None, 4, "frames"),
    ("SameStep", None, 4, "auto"),
    ("SameStep", 3, 1, "auto"),
]


@pytest.mark.parametrize(("mode", "workers", "ahead", "lane"), _WAYS)
def test_results_do_not_depend_on_who_is_ready_first(
    tmp_path: Path, lane: str, mode: str, workers: int | None, ahead: int
) -> None:
    """Each sub-environment's results are those that it gives alone, to the bit: in whatever groups
    and after whatever delays they come, and also where actions are sent before they are needed."""
    counter = (sample("counter") / "env.py").read_text()
    folder = write_repository(tmp_path, _DELAYED, counter__py=counter)
    rng, count = np.random.default_rng(3), 6
    actions = rng.integers(0, 3, (count, _STEPS))
    taken: dict[int, list[Any]] = {index: [] for index in range(count)}
    sent = [0] * count
    options = {"policy": {"lane": lane}, "num_workers": workers, "min_ready": 2}
    with make_env(folder, count, env_kwargs={"autoreset_mode": mode}, **options) as suites:
        env = suites.env
        env.reset(seed=100)

        def send(ids: list[int]) -> None:
            env.send(np.array([actions[index][sent[index]] for index in ids]), ids)
            for index in ids:
                sent[index] += 1

        resetting: set[int] = set()
        for _ in range(ahead):
            send(list(range(count)))
        while any(len(rows) < _STEPS for rows in taken.values()):
            received = env.recv(int(rng.integers(1, count + 1)))
            ids = received.env_ids.tolist()
            done = np.logical_or(received.terminations, received.truncations)
            over = [index for index, ended in zip(ids, done, strict=True) if ended]
            for place, index in enumerate(ids):
                if index not in resetting:
                    taken[index].append(_row(received, place))
            resetting -= set(ids)
            if mode == "Disabled" and over:
                env.send_reset(over)
                resetting |= set(over)
            more = [index for index in ids if sent[index] < _STEPS and index not in resetting]
            if more:
                send(more)
    for index in range(count):
        expected = _alone(folder, index, mode, actions[index])
        for step, (wanted, found) in enumerate(zip(expected, taken[index], strict=True)):
            what = f"sub-environment {index}, step {step}"
            assert_same((*wanted[:4], _own(wanted[4], 0)), found, what)


_RAISING = f"""{STILL}
import time

class Raising(Still):
    observation_space = action_space = gym.spaces.Discrete(3)

    def step(self, action):
        if action == 1:
            raise ValueError("one")
        time.sleep(0.3 * (action == 2))
        return action, 1.0, False, False, {{}}
"""


def test_an_error_does_not_overtake_the_result_before_it(tmp_path: Path, lane: str) -> None:
    """While a receipt waits for another worker, the first one's next answer may be an error."""
    folder = write_repository(tmp_path, _RAISING)
    with make_env(folder, 2, min_ready=2, policy={"lane": lane}) as suites:
        env = suites.env
        env.reset()
        env.send(np.array([0, 2]))
        env.send(np.array([1]), [0])
        received = env.recv()
        assert (received.env_ids.tolist(), received.observations.tolist()) == ([0, 1], [0, 2])
        with pytest.raises(ValueError, match="one") as info:
            env.recv()
        assert info.value.env_ids == (0,)
        env.step(np.array([0, 0]))


def test_who_has_ended_is_refused_in_its_turn(tmp_path: Path, lane: str) -> None:
    """Where nothing resets by itself, those before it have been stepped, as in Gymnasium."""
    folder, here = write_repository(tmp_path, STILL + _ENDING), dict[str, Any]()
    exec(STILL + _ENDING, here)
    expected = here["make_env"](3)
    with make_env(folder, 3, policy={"lane": lane}) as suites:
        for env in (expected, suites.env):
            env.reset()
            env.step(np.array([0, 1, 0]))
            with pytest.raises(AssertionError, match="_autoreset_envs"):
                env.step(np.zeros(3, int))
            mask = np.array([False, True, False])
            env.reset(options={"reset_mask": mask})
        zeros = np.zeros(3, int)
        assert_same(expected.step(zeros), suites.env.step(zeros), "the next step")


_ENDING = """
class Ending(Still):
    observation_space = action_space = gym.spaces.Discrete(9)

    def reset(self, **options):
        self.now = 0
        return 0, {}

    def step(self, action):
        self.now += 1
        return self.now, 1.0, action == 1, False, {}

def vector(kind, n_envs):
    return gym.vector.SyncVectorEnv([kind] * n_envs, autoreset_mode="Disabled")
"""

"""The compliance suite: what it means to be the same environment as the one in process.
Inherit from ``VectorEnvCompliance``, name a sample repository and its cases, and every test runs
on each of them. ``SyncVectorEnv`` in this process is the oracle, for ``use_async_envs`` too."""

import contextlib
import itertools
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, VectorEnv

from envhub_sandbox import SandboxVectorEnv, make_env
from tests.compliance.pair import Pair
from tests.support.compare import assert_same, assert_same_space
from tests.support.samples import reference, sample

MODES = ("NextStep", "SameStep", "Disabled")


@dataclass(frozen=True)
class Case:
    """One way to build a sample, and over how many processes to spread it."""

    n_envs: int = 3
    use_async_envs: bool = False
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    num_workers: int | None = None

    @property
    def label(self) -> str:
        words = [f"n{self.n_envs}", "async" if self.use_async_envs else "sync"]
        words += [] if self.num_workers is None else [f"{self.num_workers}workers"]
        return "-".join([*words, *map(str, self.env_kwargs.values())])


def cases(
    n_envs: tuple[int, ...] = (3,),
    use_async_envs: tuple[bool, ...] = (False, True),
    modes: tuple[str, ...] = MODES,
    async_workers: int = 2,
) -> list[Case]:
    """The product of the arguments; async cases are spread over ``async_workers`` processes."""
    return [
        Case(n, is_async, {"autoreset_mode": mode}, async_workers if is_async else None)
        for n, is_async, mode in itertools.product(n_envs, use_async_envs, modes)
    ]


def each_mode(n_envs: int) -> list[Case]:
    """Each mode once: in one process, in one, and in two."""
    return [*cases((n_envs,), (False,), MODES[1:]), *cases((n_envs,), (True,), MODES[:1])]


@contextlib.contextmanager
def paired(name: str, case: Case, **options: Any) -> Iterator[Pair]:
    """A sample's reference and its sandboxed environment, which live as long as the context."""
    expected = reference(name, case.n_envs, **case.env_kwargs)
    suites = make_env(
        sample(name),
        n_envs=case.n_envs,
        use_async_envs=case.use_async_envs,
        env_kwargs=case.env_kwargs,
        num_workers=case.num_workers,
        **options,
    )
    with suites:
        yield Pair(expected, suites.env, case.use_async_envs)
    expected.close()


class VectorEnvCompliance:
    """Inherit and set the class attributes; the tests of one case share one environment.

    Attributes:
        sample: Name of the repository under ``tests/samples``.
        cases: How to build it.
        steps: Steps of the long rollout.
        ends: Whether episodes end within these steps.
        over_frames: How many of the cases, from the last one, are run as messages, too.
    """

    sample: ClassVar[str]
    cases: ClassVar[list[Case]] = [Case()]
    steps: ClassVar[int] = 200
    ends: ClassVar[bool] = True
    over_frames: ClassVar[int] = 1

    def test_is_an_ordinary_vector_env(self, pair: Pair) -> None:
        assert isinstance(pair.sandboxed, VectorEnv)
        assert isinstance(pair.sandboxed, SandboxVectorEnv)
        assert pair.sandboxed.unwrapped is pair.sandboxed
        assert pair.sandboxed.num_envs == pair.num_envs
        assert pair.sandboxed.render_mode == pair.reference.render_mode
        assert pair.sandboxed.closed is False
        assert_same(dict(pair.reference.metadata), dict(pair.sandboxed.metadata), "metadata")

    def test_spaces_are_equal(self, pair: Pair) -> None:
        for kind in ("single_observation_space", "single_action_space"):
            assert_same_space(getattr(pair.reference, kind), getattr(pair.sandboxed, kind), kind)
        for kind in ("observation_space", "action_space"):
            assert_same_space(getattr(pair.reference, kind), getattr(pair.sandboxed, kind), kind)

    def test_long_rollout_is_bit_identical(self, pair: Pair) -> None:
        """Every result of a long rollout is the reference's, with its dtypes, masks and order."""
        ended = pair.drive(seed=7, steps=self.steps)
        assert (ended > 0) is self.ends

    def test_seeds_may_be_an_int_a_list_or_missing(self, pair: Pair) -> None:
        """Seeds mean what they mean in Gymnasium; without one the generators go on."""
        pair.reset(seed=11)
        pair.reset(seed=[100 + 7 * i for i in range(pair.num_envs)])
        pair.reset(seed=None)
        pair.reset(seed=[None] * pair.num_envs)
        pair.reset(seed=[5 if i % 2 else None for i in range(pair.num_envs)])
        for actions in pair.sample_actions(1, 2):
            pair.step(actions)

    def test_generators_are_the_sub_environments(self, pair: Pair) -> None:
        """``np_random`` and ``np_random_seed`` are tuples, as SyncVectorEnv has them."""
        for seed in ([True] * pair.num_envs, 21):
            pair.reset(seed=seed)
            assert_same(pair.reference.np_random_seed, pair.sandboxed.np_random_seed, "seeds")
        assert_same(pair.reference.np_random, pair.sandboxed.np_random, "generators")

    def test_step_in_two_halves(self, pair: Pair) -> None:
        expected = pair.reference.reset(seed=3)
        pair.sandboxed.reset_async(seed=3)
        assert_same(expected, pair.sandboxed.reset_wait(), "reset_wait")
        for actions in pair.sample_actions(3, 2):
            pair.sandboxed.step_async(actions)
            assert_same(pair.reference.step(actions), pair.sandboxed.step_wait(), "step_wait")

    def test_halves_out_of_order_are_refused(self, pair: Pair) -> None:
        pair.reset(seed=4)
        with pytest.raises(NoAsyncCallError):
            pair.sandboxed.step_wait()
        with pytest.raises(NoAsyncCallError):
            pair.sandboxed.reset_wait()
        with pytest.raises(NoAsyncCallError):
            pair.sandboxed.call_wait()
        actions = pair.sample_actions(4, 1)[0]
        pair.sandboxed.step_async(actions)
        with pytest.raises(AlreadyPendingCallError):
            pair.sandboxed.step_async(actions)
        with pytest.raises(AlreadyPendingCallError):
            pair.sandboxed.reset_async()
        with pytest.raises(NoAsyncCallError):
            pair.sandboxed.reset_wait()
        assert_same(pair.reference.step(actions), pair.sandboxed.step_wait(), "step_wait")

    def test_results_belong_to_the_caller(self, pair: Pair) -> None:
        """No later step changes what was returned, and arrays can be written to."""
        results = [pair.sandboxed.reset(seed=5), pair.reference.reset(seed=5)]
        kept = deepcopy(results)
        for actions in pair.sample_actions(5, 1):
            results.append(pair.step(actions))
            kept.append(deepcopy(results[-1]))
        for _ in range(5):
            pair.reset(seed=6)
            pair.step(pair.sample_actions(6, 1)[0])
        assert_same(kept, results, "what was returned earlier")
        for array in _arrays_in(results[-1]):
            assert array.flags.writeable
            array.fill(array.dtype.type())
        pair.reset(seed=8)
        pair.step(pair.sample_actions(8, 1)[0])

    def test_masked_reset_touches_only_the_masked(self, pair: Pair) -> None:
        pair.reset(seed=9)
        pair.step(pair.sample_actions(9, 1)[0])
        mask = np.arange(pair.num_envs) % 2 == 0
        pair.reset(seed=90, options={"reset_mask": mask})
        pair.reset(options={"reset_mask": mask, "other": 1})
        if pair.autoreset_mode is not AutoresetMode.DISABLED:
            pair.step(pair.sample_actions(10, 1)[0])

    def test_bad_reset_mask_is_refused(self, pair: Pair) -> None:
        pair.reset(seed=12)
        masks: list[Any] = [[True] * pair.num_envs, np.ones(pair.num_envs + 1, bool)]
        masks += [np.ones(pair.num_envs, int), np.zeros(pair.num_envs, bool)]
        for mask in masks:
            with pytest.raises((TypeError, ValueError)) as expected:
                pair.reference.reset(options={"reset_mask": mask})
            with pytest.raises(expected.type, match="reset_mask"):
                pair.sandboxed.reset(options={"reset_mask": mask})
        pair.reset(seed=12)

    def test_wrong_number_of_seeds_is_refused(self, pair: Pair) -> None:
        with pytest.raises(ValueError, match="seed"):
            pair.sandboxed.reset(seed=[1] * (pair.num_envs + 1))
        pair.reset(seed=13)

    def test_attribute_that_is_missing(self, pair: Pair) -> None:
        pair.reset(seed=14)
        for ask in (pair.sandboxed.call, pair.sandboxed.get_attr):
            with pytest.raises(AttributeError, match="no_such_thing"):
                ask("no_such_thing")
        with pytest.raises(AttributeError, match="no_such_thing"):
            _ = pair.sandboxed.no_such_thing
        assert not hasattr(pair.sandboxed, "no_such_thing")
        pair.step(pair.sample_actions(14, 1)[0])

    def test_wrong_actions_are_refused_before_they_leave(self, pair: Pair) -> None:
        pair.reset(seed=15)
        for nonsense in (None, "north", object(), [[[[1]]]] * (pair.num_envs + 1)):
            with pytest.raises((TypeError, ValueError)):
                pair.sandboxed.step(nonsense)
        pair.step(pair.sample_actions(15, 1)[0])

    def test_attribute_of_sub_environments(self, pair: Pair) -> None:
        values = [float(i) for i in range(pair.num_envs)]
        for value in (values, tuple(values), 3, "text", np.arange(3)):
            for env in (pair.reference, pair.sandboxed):
                env.set_attr("envhub_note", value)
            expected = pair.reference.get_attr("envhub_note")
            assert_same(expected, pair.sandboxed.get_attr("envhub_note"), "get_attr")
            assert_same(expected, pair.sandboxed.call("envhub_note"), "call")
        with pytest.raises(ValueError, match="length"):
            pair.sandboxed.set_attr("envhub_note", [1] * (pair.num_envs + 1))


def _arrays_in(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        yield value
    elif isinstance(value, dict):
        yield from itertools.chain.from_iterable(map(_arrays_in, value.values()))
    elif isinstance(value, (list, tuple)):
        yield from itertools.chain.from_iterable(map(_arrays_in, value))

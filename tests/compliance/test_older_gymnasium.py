"""Repositories on releases of Gymnasium that are older than the client's, and another numpy.
The oracle is the client's own Gymnasium, in the mode that the older release had: what a repository
on 0.29 gives is what the same repository would give here with ``SAME_STEP``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_worker.protocol.runtime import Runtime
from tests.compliance import test_parity
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case
from tests.support.compare import assert_same
from tests.support.packages.environments import installed_once, running_on
from tests.support.samples import reference, sample

OLDEST = ("gymnasium==0.26.3", "numpy==1.23.5")
OLD = ("gymnasium==0.29.1", "numpy==1.26.4")
FIRST = ("gymnasium==1.0.0", "numpy==1.26.4")
NEW = ("gymnasium>=1.1", "numpy>=2")


@pytest.fixture(scope="session")
def runtimes() -> Iterator[Any]:
    with installed_once() as runtime:
        yield runtime


@dataclass(frozen=True)
class OlderCase(Case):
    """A way to build the sample under an older release."""

    requirements: tuple[str, ...] = OLD
    mode: str = "SameStep"
    env_kwargs: dict[str, Any] = field(default_factory=lambda: {"autoreset_mode": None})

    @property
    def label(self) -> str:
        return f"{super().label}-{self.requirements[0]}"


@contextmanager
def opened(name: str, case: Case, runtime: Runtime, **options: Any) -> Iterator[Any]:
    arguments = {"n_envs": case.n_envs, "use_async_envs": case.use_async_envs}
    with running_on(runtime):
        suites = make_env(
            sample(name),
            env_kwargs=case.env_kwargs,
            num_workers=case.num_workers,
            **arguments,
            **options,
        )
        with suites:
            yield suites.env


@pytest.fixture(scope="class")
def pair(case: OlderCase, lane: str, runtimes: Any) -> Iterator[Pair]:
    """The reference in the client's Gymnasium, and the older one in a jail."""
    expected = reference("counter", case.n_envs, autoreset_mode=case.mode)
    with opened("counter", case, runtimes(case.requirements), policy={"lane": lane}) as env:
        yield Pair(expected, env, case.use_async_envs)
    expected.close()


class TestOlderCounter(test_parity.TestCounter):
    """The whole suite, with the worker's own loop, sliced and not."""

    over_frames = 1
    cases = [  # noqa: RUF012
        OlderCase(requirements=OLDEST),
        OlderCase(use_async_envs=True, num_workers=2),
        OlderCase(requirements=FIRST, mode="NextStep"),
    ]


def test_a_vector_environment_of_0_29_is_driven_as_it_is(runtimes: Any) -> None:
    """Its mode is stated, and its last observations and infos are called as today."""
    kwargs = {"autoreset_mode": None, "subclass": True}
    case = OlderCase(env_kwargs=kwargs, use_async_envs=True)
    expected = reference("counter", case.n_envs, autoreset_mode=case.mode)
    with opened("counter", case, runtimes(OLD)) as env:
        assert_same(dict(expected.metadata), dict(env.metadata), "metadata")
        assert_same(expected.reset(seed=3)[0], env.reset(seed=3)[0], "observation")
        ended = 0
        for actions in Pair(expected, env).sample_actions(3, 30):
            theirs, ours = expected.step(actions), env.step(actions)
            for index in (0, 2, 3):
                assert_same(theirs[index], ours[index], f"result {index}")
            np.testing.assert_array_equal(theirs[1], ours[1])  # AsyncVectorEnv kept their dtype
            for key in ("final_obs", "_final_obs", "_final_info"):
                assert_same(theirs[4].get(key), ours[4].get(key), key)
            done = np.logical_or(ours[2], ours[3])
            ended += int(done.sum())
            if done.any():
                infos = theirs[4]["final_info"], ours[4]["final_info"]
                assert_same(infos[0]["count"], infos[1]["count"], "final_info")
        assert ended
    expected.close()


def test_a_repository_may_be_on_an_older_release_beside_one_on_a_newer(runtimes: Any) -> None:
    """One client, three environments at once: 0.29 with numpy 1.26, the newest, and its own."""
    case = OlderCase(n_envs=2)
    with (
        opened("counter", case, runtimes(OLD)) as old,
        opened("counter", OlderCase(n_envs=2, requirements=NEW), runtimes(NEW)) as new,
        make_env(sample("counter"), n_envs=2) as own,
    ):
        expected = reference("counter", 2)
        first = expected.reset(seed=5)
        for env in (old, new, own.env):
            assert_same(first, env.reset(seed=5), "reset")
        for actions in Pair(expected, new).sample_actions(5, 20):
            one = expected.step(actions)
            assert_same(one, new.step(actions), "new")
            assert_same(one, own.env.step(actions), "own")
            old.step(actions)
        expected.close()

"""One server of a fleet is hostile: its answers are refused, and no other's rows change.
It may end what it serves, which costs the caller an error. The rows of the others are as they were,
and their workers go on."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox import errors, make_env
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.manifest.manifest import Manifest, encode_env, encode_manifest
from envhub_worker.protocol.spaces import batches
from tests.attacks.client.lies import refuses, relayed
from tests.attacks.client.lying_server import (
    ACTION,
    NUM_ENVS,
    OBSERVATION,
    LyingSandbox,
    LyingServer,
    env_manifest,
    lying,
    step_done,
)
from tests.support import inside, wire

ALL = 2 * NUM_ENVS
"""Rows of the fleet: the first are the liar's, the others those of an honest server."""
HONEST = slice(NUM_ENVS, ALL)
ACTIONS = [0] * ALL
TRUE = {"observation": np.full((NUM_ENVS, 3), 0.5, np.float32), "rewards": np.full(NUM_ENVS, 7.0)}
INFO = {
    "a": np.arange(NUM_ENVS),
    "_a": np.ones(NUM_ENVS, bool),
    batches.APART_CLASSES: {"a": False},
}


@pytest.fixture
def honest() -> Iterator[LyingServer]:
    with lying() as server:
        yield server


@contextmanager
def fleet(liar: LyingServer, honest: LyingServer, folder: str, **policy: Any) -> Iterator[Any]:
    whole = {"sync": True, "type_name": "gymnasium.vector.SyncVectorEnv"}
    described = wire.env_manifest(OBSERVATION, ACTION, ALL, **whole)
    for server in (liar, honest):
        manifest = encode_manifest(Manifest(envs=(described,), lazy=True))
        server.lies[m.Load] = relayed(m.LoadDone(manifest))
        server.lies[m.LoadTask] = relayed(m.Value((ALL, True)))
        server.lies[m.Step] = relayed(step_done(**TRUE, info=INFO))
        server.lies[m.Call] = relayed(m.Value(("true",) * NUM_ENVS))
    options: dict[str, Any] = {
        "timeouts": {"startup_s": 60.0, "step_s": 60.0, "reset_s": 60.0, "close_s": 1.0},
        "policy": policy,
    }
    places = [LyingSandbox(liar), LyingSandbox(honest)]
    with make_env(folder, n_envs=ALL, sandbox=places, **options) as suites:
        suites.env.reset()
        yield suites.env


def states(env: Any) -> list[str]:
    return [part.lifecycle.state.name for part in inside.parts(env)]


def _zeros(*shape: int, dtype: Any = np.float32) -> Any:
    return np.zeros(shape, dtype)


LIES: dict[str, dict[str, Any]] = {
    "observations of all rows": {"observation": _zeros(ALL, 3)},
    "observations of one row": {"observation": _zeros(1, 3)},
    "observations of another space": {"observation": _zeros(NUM_ENVS, 4)},
    "observations of another dtype": {"observation": _zeros(NUM_ENVS, 3, dtype=np.float64)},
    "rewards of all rows": {"rewards": np.zeros(ALL)},
    "several rewards for each row": {"rewards": np.zeros((NUM_ENVS, 3))},
    "the ends of all rows": {"terminations": np.ones(ALL, bool)},
    "no truncations": {"truncations": np.ones(0, bool)},
}


def test_what_is_not_checked_changes_the_others_rows(liar: LyingServer) -> None:
    """The control: the same lie, joined as it comes, is taken for rows that are not its own."""
    described = wire.env_manifest(OBSERVATION, ACTION, ALL, sync=True)
    joins = Results(described, [(0, NUM_ENVS), (NUM_ENVS, ALL)])
    lie = step_done(**(TRUE | LIES["observations of all rows"]))
    true = step_done(**TRUE)
    parts = [(x.observation, x.rewards, x.terminations, x.truncations, {}) for x in (lie, true)]
    observations = joins.joined_steps(parts)[0]
    assert not np.array_equal(observations[HONEST], TRUE["observation"])


@pytest.mark.parametrize("what", LIES)
def test_rows_that_are_not_its_own_are_refused(
    liar: LyingServer, honest: LyingServer, folder: str, what: str
) -> None:
    with fleet(liar, honest, folder, restart="on_reset") as env:
        before = liar.lies[m.Step]
        liar.lies[m.Step] = relayed(step_done(**(TRUE | LIES[what])))
        error = refuses(lambda: env.step(ACTIONS))
        assert isinstance(error, errors.RemoteProtocolError)
        assert f"sub-environments 0 to {NUM_ENVS - 1} of {ALL}" in str(error)
        assert states(env) == ["DEAD", "READY"]
        liar.lies[m.Step] = before
        opened = sum(isinstance(one, m.OpenJail) for one in honest.asked)
        env.reset()
        observations, rewards, *_ = env.step(ACTIONS)
        assert np.array_equal(observations[HONEST], TRUE["observation"])
        assert rewards[HONEST].tolist() == [7.0] * NUM_ENVS
        assert sum(isinstance(one, m.OpenJail) for one in honest.asked) == opened


@pytest.mark.parametrize("sync", [True, False], ids=["the control", "absurdly many"])
def test_no_more_workers_than_sub_environments_of_one_task(
    liar: LyingServer, honest: LyingServer, folder: str, sync: bool
) -> None:
    """A session for each worker takes 16 KB before it starts; tasks may be thousands."""
    facts: dict[str, Any] = {"sync": sync, "independent": False}
    tasks = [env_manifest(task=n, num_envs=MAX_NUM_ENVS // 2 + 1, **facts) for n in range(2)]
    value = {**encode_manifest(Manifest(envs=(), lazy=True)), "envs": tuple(map(encode_env, tasks))}
    liar.lies[m.Load] = relayed(m.LoadDone(value))
    places = [LyingSandbox(liar), LyingSandbox(honest)]
    if sync:
        make_env(folder, n_envs=ALL, sandbox=places).close()
    else:
        error = refuses(lambda: make_env(folder, n_envs=ALL, sandbox=places))
        assert "give num_workers" in str(error)


def test_values_for_others_are_refused(liar: LyingServer, honest: LyingServer, folder: str) -> None:
    with fleet(liar, honest, folder) as env:
        assert env.call("x", 1) == ("true",) * ALL  # the control
        liar.lies[m.Call] = relayed(m.Value(("lie",) * ALL))
        assert isinstance(refuses(lambda: env.call("x", 1)), errors.RemoteProtocolError)
        assert states(env) == ["DEAD", "READY"]


_PLAIN = {"a": False}
OWN: dict[str, dict[Any, Any]] = {
    "of a row of the other's": {2 * NUM_ENVS: {"a": -1}},
    "of no row": {"0": {"a": -1}},
    "that are no mapping": {0: [1]},
    "whose mask is no text": {0: {"a": -1}, batches.APART_FORMS: {0: {"a": (3, True, {}, {})}}},
    "whose inner forms are none": {
        0: {"a": {}},
        batches.APART_FORMS: {0: {"a": ("_a", False, 1, {})}},
    },
    "whose numbers are texts": {
        0: {"a": -1},
        batches.APART_FORMS: {0: {"a": ("_a", True, {}, {"i": "1"})}},
    },
    "whose blank structure is large": {
        0: {"a": -1},
        batches.APART_FORMS: {0: {"a": ("_a", True, {}, {"V": np.zeros(9)})}},
    },
    "whose forms are none": {0: {"a": 1}, batches.APART_FORMS: 3},
    "in columns without classes": {"x": np.ones(2), "_x": np.ones(2, bool)},
    "in columns of all rows": {"a": np.zeros(ALL), "_a": 1, batches.APART_CLASSES: _PLAIN},
    "in columns of no numbers": {"a": np.full(2, None), "_a": 1, batches.APART_CLASSES: _PLAIN},
    "in columns that are missing": {batches.APART_CLASSES: _PLAIN},
    "in nested columns of none": {"a": 5, "_a": 1, batches.APART_CLASSES: {"a": _PLAIN}},
    "in nested columns of all rows": {
        "b": {"a": np.zeros(ALL), "_a": 1},
        "_b": 1,
        batches.APART_CLASSES: {"b": _PLAIN},
    },
    "in columns of no class": {"a": np.zeros(NUM_ENVS), "_a": 1, batches.APART_CLASSES: ["a"]},
}


@pytest.mark.parametrize("what", OWN)
def test_others_infos_refused(
    liar: LyingServer, honest: LyingServer, folder: str, what: str
) -> None:
    """Each worker's infos are of its own rows, as columns or one by one."""
    with fleet(liar, honest, folder) as env:
        liar.lies[m.Step] = relayed(step_done(**TRUE, info={0: {"a": 8}, 1: {"a": 9.5}}))
        assert env.step(ACTIONS)[4]["a"].tolist() == [8, 9, 0, 1]  # the control
        liar.lies[m.Step] = relayed(step_done(**TRUE, info=OWN[what]))
        error = refuses(lambda: env.step(ACTIONS))
        assert isinstance(error, errors.RemoteProtocolError)
        assert states(env) == ["DEAD", "READY"]


def test_own_infos_that_would_take_too_much_are_refused() -> None:
    """Joined here, one row's makes a column for all; and what does not fit is told in short."""
    joins = Results(wire.env_manifest(OBSERVATION, ACTION, 64, sync=True), [(0, 1), (1, 64)])
    large = {0: {"a": np.zeros(1 << 20, np.uint8)}}
    assert joins.infos([large, {}])["a"].shape == (64, 1 << 20)  # the control
    joins.max_bytes = 32 << 20
    with pytest.raises(errors.MessageTooLargeError):
        joins.infos([large, {}])
    name = "x" * 100_000
    with pytest.raises(errors.RemoteEnvError) as caught:
        joins.infos([{0: {name: 1.0}}, {0: {name: "text"}}])
    assert len(str(caught.value)) < 1000


def test_infos_that_came_apart_are_of_its_own_rows_alone() -> None:
    """Whatever place a worker names, no other's infos change."""
    joins = Results(wire.env_manifest(OBSERVATION, ACTION, 3, sync=True), [(0, 1), (1, 3)])
    joins.apart = True
    honest = {1: {"a": 2}, 3: {"b": 3}}
    ended = joins.own(joins.infos([{0: {"a": 1}}, honest]))[0]
    assert ended == [[{"a": 1}], [], [{"a": 2}, {"b": 3}]]  # the control
    for key in (-5, -(1 << 70)):
        lied = joins.own(joins.infos([{key: {"a": 9}}, honest]))[0]
        assert lied == [[], [], [{"a": 2}, {"b": 3}]]
    lies: list[Any] = [{place: {"a": 9}} for place in ("0", True, None, 2, 5, 1 << 70)]
    lies += [{0: 5}, {0: RemoteObject("t", "r")}, {"x": np.ones(1), "_x": np.ones(1, bool)}]
    for infos in lies:
        with pytest.raises(errors.RemoteProtocolError):
            joins.own(joins.infos([infos, honest]))


def test_rewards_of_different_shapes_are_not_joined() -> None:
    """Several for each sub-environment are permitted, and a worker may lie about how many."""
    joins = Results(wire.env_manifest(OBSERVATION, ACTION, 2, sync=False), [(0, 1), (1, 2)])
    over = np.zeros(1, bool)
    parts: list[Any] = [(_zeros(1, 3), _zeros(1, several), over, over, {}) for several in (2, 3)]
    with pytest.raises(errors.RemoteProtocolError, match="different shapes"):
        joins.joined_steps(parts)


def test_another_space_is_refused_before_the_first_step(
    liar: LyingServer, honest: LyingServer, folder: str
) -> None:
    """All workers have the spaces that the first one has described, and no more rows than they were
    built for, or none is used."""
    other = spaces.Box(-1, 1, (4,), np.float32)
    built = env_manifest(single_observation_space=other)
    honest.lies[m.Build] = relayed(m.BuildDone(encode_env(built)))
    named = "spaces are not equivalent"
    with pytest.raises(errors.RemoteEnvError, match=named), fleet(liar, honest, folder):
        pass
    del honest.lies[m.Build]
    with fleet(liar, honest, folder):  # the control
        pass
    built = wire.env_manifest(OBSERVATION, ACTION, ALL, sync=True)
    liar.lies[m.Build] = relayed(m.BuildDone(encode_env(built)))
    with pytest.raises(errors.EnvHubError), fleet(liar, honest, folder):
        pass

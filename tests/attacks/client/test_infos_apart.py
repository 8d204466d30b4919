"""A worker that lies about infos that are not joined: a single environment takes none of it."""

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.session.lease import AttributeCache
from envhub_sandbox.transport.results import Results
from envhub_sandbox.vector.single_env import SingleEnv
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import Manifest, encode_env, encode_manifest
from envhub_worker.protocol.spaces import batches
from envhub_worker.runner.described import described
from tests.attacks.client.lies import (
    GROWTH,
    Canary,
    opened,
    peak_growth,
    pickled,
    refuses,
    relayed,
)
from tests.attacks.client.lying_server import ACTION, OBSERVATION, LyingServer
from tests.support import wire


def _done(info: Any, **changes: Any) -> m.StepDone:
    fields: dict[str, Any] = {
        "observation": np.zeros((1, 3), np.float32),
        "rewards": np.zeros(1),
        "terminations": np.zeros(1, bool),
        "truncations": np.zeros(1, bool),
    }
    return m.StepDone(**(fields | changes), info=info)


@contextmanager
def _single(liar: LyingServer, folder: str) -> Iterator[SingleEnv]:
    changes: Any = {"sync": True, "type_name": "gymnasium.vector.SyncVectorEnv"}
    described = wire.env_manifest(OBSERVATION, ACTION, 1, **changes)
    liar.lies[m.Load] = relayed(m.LoadDone(encode_manifest(Manifest(envs=(described,), lazy=True))))
    liar.lies[m.LoadTask] = relayed(m.Value((1, True)))
    liar.lies[m.Build] = relayed(m.BuildDone(encode_env(described)))
    liar.lies[m.Reset] = relayed(m.ResetDone(np.zeros((1, 3), np.float32), {0: {"begun": 1}}))
    with opened(liar, folder, n_envs=1) as suites:
        env = SingleEnv(suites.env)
        assert env.reset()[1] == {"begun": 1}
        yield env


def test_an_honest_one_is_believed(liar: LyingServer, folder: str) -> None:
    """The control: what the lies look like is taken, where it is true."""
    with _single(liar, folder) as env:
        action = env.action_space.sample()
        for info in ({0: {"a": 2**80}}, {0: {}}, {}, {0: {"a": {"_a": 1}}, -1: ()}):
            liar.lies[m.Step] = relayed(_done(info))
            assert env.step(action)[4] == info.get(0, {})
        liar.lies[m.Step] = relayed(_done({-2: ([1.0, 2.0],)}))
        assert env.step(action)[1:] == ([1.0, 2.0], False, False, {})


LIES: dict[str, Any] = {
    "a number for infos": {0: 3},
    "a list for infos": {0: [1]},
    "a text for infos": {0: "ab", 1: {}},
    "too many infos": {0: {}, 1: {}, 2: {}},
    "infos of nowhere": {10**9: {}, 10**9 + 1: {}, 5: {}},
    "a number for integers": {0: {}, -1: 3},
    "a text for integers": {-1: "xxx"},
    "arrays for integers": {-1: np.ones(3)},
    "a number for a reward": {-2: 3},
    "two rewards": {-2: ([1.0], [2.0])},
}


@pytest.mark.parametrize("what", LIES)
def test_infos_of_another_form_are_refused(liar: LyingServer, folder: str, what: str) -> None:
    with _single(liar, folder) as env:
        action = env.action_space.sample()
        liar.lies[m.Step] = relayed(_done(LIES[what]))
        assert isinstance(refuses(lambda: env.step(action)), RemoteProtocolError)


COUNT = 512
"""Sub-environments of a shard among two, each of which sends its infos as columns."""


def _columns(keys: int, value: np.ndarray, *, is_numpys: bool = True) -> dict[Any, Any]:
    names = list(map(str, range(keys)))
    masks = {f"_{name}": None for name in names}
    classes = dict.fromkeys(names, is_numpys)
    return {**dict.fromkeys(names, value), **masks, batches.APART_CLASSES: classes}


@pytest.mark.parametrize(
    "lie",
    [
        _columns(30_000, np.zeros((COUNT, 0))),
        _columns(1, np.zeros((COUNT, 30_000), np.int8), is_numpys=False),
    ],
    ids=["empty arrays", "numbers of Python"],
)
def test_columns_take_no_more_memory_than_their_message_may(lie: dict[Any, Any]) -> None:
    """In the client each value of a row is an object. The control is joined."""
    count = 2 * COUNT
    described = wire.env_manifest(OBSERVATION, ACTION, count)
    results = Results(described, [(0, COUNT), (COUNT, count)])
    honest = results.infos([_columns(3, np.zeros((COUNT, 2))), {}])
    assert honest["0"].shape == (count, 2)

    def read() -> None:
        with pytest.raises(RemoteProtocolError, match="infos are not"):
            results.infos([lie, {}])

    assert peak_growth(read) < GROWTH


def test_only_a_space_is_shown_as_one(
    liar: LyingServer, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a reset that is said to have replaced the spaces; the control is a space."""
    monkeypatch.setattr(AttributeCache, "take_seeded", lambda cache: True)
    with _single(liar, folder) as env:
        for value, shown in (("text", ACTION), ({"n": 1}, ACTION), (spaces.Discrete(9),) * 2):
            frames = m.pack(m.Value(value), describer=described)
            liar.lies[m.GetOne] = relayed([bytes(frame) for frame in frames])
            env.reset()
            assert env.action_space == shown
            assert env.vector.single_action_space == ACTION


def test_pickles_in_infos_are_never_loaded(liar: LyingServer, folder: str, tmp_path: Path) -> None:
    """The control loads one."""
    canary = tmp_path / "executed"
    with _single(liar, folder) as env:
        action = env.action_space.sample()
        liar.lies[m.Step] = relayed(pickled(_done({0: {"a": Canary(canary)}})))
        refuses(lambda: env.step(action))
    assert not canary.exists()
    pickle.loads(cloudpickle.dumps(Canary(canary)))
    assert canary.exists()

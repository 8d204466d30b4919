"""Steps that a server takes: what it and the jail put into the slabs, in any size and of any kind.
The server is one that lies. The control is the same server, which is honest once."""

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import cloudpickle
import numpy as np
import pytest

from envhub_sandbox.errors import RemoteProtocolError
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs
from tests.attacks.client.lies import ACTIONS, Canary, refuses, relayed, started
from tests.attacks.client.lying_server import NUM_ENVS, OBSERVATION, LyingServer, lying
from tests.support.repositories import CARTPOLES, write_repository

LAYOUT = slabs.observation_layout(OBSERVATION, NUM_ENVS, 1)
assert LAYOUT is not None
BATCH = bytes(LAYOUT.total_bytes)
MOST = slabs.INFO_BYTES


def head(outcome: int, length: int = 0) -> bytes:
    return struct.pack("<QQ", outcome, length)


PLAIN = head(slabs.DONE)
NO_INFOS = bytes(m.pack(m.Value({}))[0])
NO_MAPPING = bytes(m.pack(m.Value(7))[0])
IN_A_JAIL = bytes(m.pack(m.Step(1, 0))[0])
LIES = {
    "nothing": [b""],
    "half a head": [PLAIN[:8]],
    "no batch": [PLAIN],
    "less": [PLAIN + BATCH[:-1]],
    "more": [PLAIN + BATCH + b"x"],
    "much more": [PLAIN, *[bytes(1 << 20)] * 64],
    "many empty frames": [PLAIN + BATCH[:-1], *[b""] * 1000],
    "no such outcome": [head(9) + BATCH],
    "no outcome": [head(0) + BATCH],
    "an endless length": [head(slabs.DONE, 2**64 - 1) + bytes(MOST) + BATCH],
    "a length too long": [head(slabs.DONE, MOST + 1) + bytes(MOST) + BATCH],
    "infos that are not there": [head(slabs.DONE, MOST) + BATCH],
    "zeros for infos": [head(slabs.DONE, 64) + bytes(64) + BATCH],
    "noise for infos": [head(slabs.DONE, 64) + b"\xff" * 64 + BATCH],
    "no mapping for infos": [head(slabs.DONE, len(NO_MAPPING)) + NO_MAPPING + BATCH],
    "another message": [head(slabs.DONE, len(IN_A_JAIL)) + IN_A_JAIL + BATCH],
    "columns of nothing": [head(slabs.COLUMNS) + BATCH],
}


@pytest.fixture
def liar() -> Iterator[LyingServer]:
    with lying() as made:
        made.lies[m.ShareSlabs] = lambda asked: [asked.answer(m.Done())]
        made.lies[m.Attach] = relayed(m.Value(True))
        yield made


@pytest.fixture
def folder(tmp_path: Path) -> str:
    """A repository, which is never executed."""
    return str(write_repository(tmp_path / "repository", CARTPOLES))


def test_what_is_honest_is_read(liar: LyingServer, folder: str) -> None:
    """The control: in one frame, or in many; what the caller has is its own."""
    batch = bytearray(BATCH)
    batch[: NUM_ENVS * 12] = np.full(NUM_ENVS * 3, 0.5, np.float32).tobytes()
    flags = LAYOUT.results + NUM_ENVS * 8
    batch[flags : flags + 1] = b"\x02"  # neither true nor false
    pieces = [bytes(batch[start : start + 7]) for start in range(0, len(batch), 7)]
    infos = head(slabs.DONE, len(NO_INFOS)) + NO_INFOS
    with started(liar, folder) as env:
        for frames in ([PLAIN + batch], [PLAIN, *pieces], [infos + batch]):
            liar.lies[m.Relay] = relayed([bytes(one) for one in frames])
            observation, rewards, terminations, truncations, info = env.step(ACTIONS)
            np.testing.assert_array_equal(observation, np.full((NUM_ENVS, 3), 0.5, np.float32))
            assert rewards.tolist() == [0.0] * NUM_ENVS
            assert terminations.tolist() == [True] + [False] * (NUM_ENVS - 1)
            assert set(terminations.tobytes()) <= {0, 1}
            assert not truncations.any()
            assert info == {}
            observation[:], rewards[:], terminations[:] = 1, 1, False


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_refused(liar: LyingServer, folder: str, lie: str) -> None:
    liar.lies[m.Relay] = relayed(LIES[lie])
    with started(liar, folder) as env:
        assert isinstance(refuses(lambda: env.step(ACTIONS)), RemoteProtocolError)


def test_a_pickle_among_infos_is_not_loaded(liar: LyingServer, folder: str, tmp_path: Path) -> None:
    canary = Canary(tmp_path / "executed")
    infos = bytes(m.pack(m.Value({"a": canary}), pickler=cloudpickle.dumps)[0])
    liar.lies[m.Relay] = relayed([head(slabs.DONE, len(infos)) + infos + BATCH])
    with started(liar, folder) as env:
        refuses(lambda: env.step(ACTIONS))
    assert not os.path.exists(canary.path)


def test_more_parts_than_were_asked_are_refused(liar: LyingServer, folder: str) -> None:
    liar.lies[m.Relay] = lambda asked: [
        [*m.pack_header(m.RelayDone((1, 1)), asked.request_id), PLAIN + BATCH, PLAIN + BATCH]
    ]
    with started(liar, folder) as env:
        refuses(lambda: env.step(ACTIONS))

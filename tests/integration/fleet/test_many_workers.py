"""Hundreds of workers behind one environment: nothing in the client is bounded by their number.
One server in this process answers for all of them, so that it is the client that is tried."""

import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import Manifest, encode_env, encode_manifest
from tests.attacks.client.lies import relayed
from tests.attacks.client.lying_server import (
    ACTION,
    OBSERVATION,
    Asked,
    LyingSandbox,
    LyingServer,
    lying,
    step_done,
)
from tests.support import inside, wire
from tests.support.repositories import write_repository

WORKERS = 1100
"""More than libzmq has sockets for by default, and more than Python nests calls."""
_DESCRIPTORS = 6 * WORKERS


@pytest.fixture
def server() -> Iterator[LyingServer]:
    """Answers for as many jails as are wanted, each with the row that it was built for."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if most < _DESCRIPTORS:
        pytest.skip(f"needs {_DESCRIPTORS} descriptors (ulimit -n)")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(before[0], _DESCRIPTORS), most))
    with lying() as found:
        starts: dict[int, int] = {}
        honest = {"sync": True, "type_name": "gymnasium.vector.SyncVectorEnv"}
        whole = wire.env_manifest(OBSERVATION, ACTION, WORKERS, **honest)
        one = wire.env_manifest(OBSERVATION, ACTION, 1, **honest)

        def built(asked: Asked) -> list[Any]:
            request: Any = asked.request
            starts[request.env] = request.start
            return [asked.answer(m.BuildDone(encode_env(one)))]

        def row(asked: Asked) -> Any:
            request: Any = asked.request
            return np.full((1, 3), starts[request.env], np.float32)

        def stepped(asked: Asked) -> list[Any]:
            flags = {name: np.zeros(1, bool) for name in ("terminations", "truncations")}
            done = step_done(observation=row(asked), rewards=np.zeros(1), **flags)
            return [asked.answer(done)]

        manifest = encode_manifest(Manifest(envs=(whole,), lazy=True))
        found.lies[m.Load] = relayed(m.LoadDone(manifest))
        found.lies[m.LoadTask] = relayed(m.Value((WORKERS, True)))
        found.lies[m.Build] = built
        found.lies[m.Reset] = lambda asked: [asked.answer(m.ResetDone(row(asked), {}))]
        found.lies[m.Step] = stepped
        yield found
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_hundreds_of_workers(server: LyingServer, tmp_path: Path) -> None:
    """Each row is where it belongs, in a reset and in a step; and all of it ends."""
    folder = write_repository(tmp_path, f"# {tmp_path}")
    options = {"n_envs": WORKERS, "num_workers": WORKERS, "policy": {"lane": "frames"}}
    timeouts = {"startup_s": 300.0, "reset_s": 300.0, "step_s": 300.0}
    place = LyingSandbox(server)
    with make_env(folder, sandbox=[place, place], timeouts=timeouts, **options) as suites:
        assert suites.env.reset()[0][:, 0].tolist() == list(range(WORKERS))
        observations = suites.env.step(np.zeros(WORKERS, int))[0]
        assert observations[:, 0].tolist() == list(range(WORKERS))
        assert len(inside.parts(suites.env)) == WORKERS
    assert inside.state(suites.env).name == "CLOSED"
    closes = sum(isinstance(one, m.CloseJail) for one in server.asked)
    assert closes >= WORKERS

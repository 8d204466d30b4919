"""Two hosts for real: delay, loss, a cable that is out, and what comes back after it."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import SandboxUnavailableError, WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from tests.remote.conftest import IMPATIENT_S
from tests.remote.hosts import OtherHost, other_host
from tests.remote.listening import Listening, counting, listening
from tests.remote.relay import relay
from tests.support import inside
from tests.support.ports import lasting_port
from tests.support.processes import eventually
from tests.support.started import started

HEARTBEAT_S = 5.0
"""Longer than a loaded machine takes the core from one of the two."""


@pytest.fixture
def far() -> Iterator[OtherHost]:
    with other_host() as host:
        yield host


@pytest.fixture
def far_server(far: OtherHost, tmp_path: Path) -> Iterator[Listening]:
    bind = f"tcp://{far.address}:5555"
    with listening(tmp_path / "server", "--idle-s", "60", bind=bind, prefix=far.prefix) as found:
        yield found


def test_another_host_is_far_away_and_cut_off(
    far_server: Listening, far: OtherHost, repository: Path
) -> None:
    """With packets lost on the way, steps are the ones of the one environment over there. A
    connection that is lost between two steps is made anew, and the episode goes on. Who waits for
    a step hears of it by the heartbeat; with the cable in again, reset() has a fresh jail."""
    far.disturb(delay_ms=5, loss_percent=2)
    sandbox, still = far_server.sandbox(heartbeat_s=HEARTBEAT_S), np.zeros(2, int)
    options = {"timeouts": {"step_s": 120.0}, "policy": {"restart": "on_reset"}}
    with started(repository, n_envs=2, sandbox=sandbox, **options) as env:
        for count in range(1, 30):
            assert env.step(still)[0].tolist() == [[count], [count]]
        assert {layer["layer"] for layer in env.sandbox.report()} >= {"seccomp", "landlock"}
        link = inside.link(env)
        far.unplug()
        assert eventually(lambda: link.drain() or not inside.link_is_up(link))
        far.plug()
        assert env.step(still)[0].tolist() == [[30], [30]], "it is the same one"
        env.step_async(np.array([99, 99]))  # it takes longer than to pull the cable
        far.unplug()
        with pytest.raises(WorkerDiedError, match=r"connection to tcp://.* was lost") as caught:
            env.step_wait()
        assert caught.value.reason == "connection"
        far.plug()
        env.reset(seed=1)
        assert env.step(still)[0].tolist() == [[1.0], [1.0]]
    assert eventually(lambda: far_server.jails() == 0)


def test_nobody_at_the_other_end_is_said_to_be_so(
    repository: Path, server: Listening, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A port where nobody listens is an error in bounded time, not a wait for ever."""
    monkeypatch.setattr("envhub_sandbox.extras.remote.tcp.CONNECT_S", 2.0)
    endpoint = f"tcp://127.0.0.1:{lasting_port()}"
    with pytest.raises(SandboxUnavailableError, match="nothing answers at"):
        make_env(repository, sandbox=server.sandbox(endpoint=endpoint))


def test_a_connection_that_breaks_is_made_anew(server: Listening, repository: Path) -> None:
    """Without another host: the wire breaks, the session is found again."""
    with (
        relay(server.port) as wire,
        started(repository, sandbox=server.sandbox(endpoint=wire.endpoint)) as env,
    ):
        for count in range(1, 4):
            assert env.step(np.array([0]))[0].tolist() == [[count]]
            link = inside.link(env)
            before = inside.link_losses(link)
            wire.cut()
            assert eventually(lambda: link.drain() or inside.link_losses(link) > before)  # noqa: B023


def test_a_long_step_is_no_lost_connection(server: Listening, repository: Path) -> None:
    """Heartbeats are answered while the environment computes for several of them."""

    def steps() -> bool:
        with started(repository, sandbox=server.sandbox(heartbeat_s=0.4)) as env:
            return bool(env.step(np.array([20]))[0].tolist() == [[1.0]])

    # a machine that takes its core from the server for so long does lose a connection
    for _ in range(9):
        with contextlib.suppress(WorkerDiedError):
            assert steps()
            return
    assert steps()


def test_a_client_that_was_silent_is_told_so(impatient: Listening, repository: Path) -> None:
    """Its jail was ended; when it comes back it hears why."""
    with started(repository, sandbox=impatient.sandbox()) as env:
        inside.fall_silent(env)
        # the last that is heard says what is held: else that could count as given up before
        held = m.KeepAlive((inside.jail(env).number,))
        inside.client(env).request(held, deadline=Deadline(60))
        assert eventually(lambda: impatient.jails() == 0)
        said = f"its client has sent nothing for {IMPATIENT_S} s"
        with pytest.raises(WorkerDiedError, match=said):
            env.step(np.array([0]))


def test_a_restarted_server_says_that_the_jail_is_gone(tmp_path: Path) -> None:
    """Same keys, same port, another process: it knows nothing of the jail, and says so."""
    repository = counting(tmp_path / "repository")
    bind = f"tcp://127.0.0.1:{lasting_port()}"  # which nobody gets in between
    with listening(tmp_path / "one", bind=bind) as first:
        suites = make_env(repository, sandbox=first.sandbox(), policy={"restart": "on_reset"})
        suites.env.reset(seed=1)
    with listening(tmp_path / "one", bind=bind):
        with pytest.raises(WorkerDiedError, match="the server was restarted"):
            suites.env.step(np.array([0]))
        suites.env.reset(seed=1)
        assert suites.env.step(np.array([0]))[0].tolist() == [[1.0]]
        suites.close()


_CLIENT = """
import sys
from envhub_sandbox import RemoteSandbox, make_env
endpoint, server_key, client_key, repository = sys.argv[1:]
suites = make_env(repository, sandbox=RemoteSandbox(endpoint, server_key, client_key))
suites.env.reset()
print("ready", flush=True)
sys.stdin.read()
"""


def test_a_killed_clients_jails_end(impatient: Listening, repository: Path) -> None:
    client = subprocess.Popen(
        [
            *(sys.executable, "-c", _CLIENT, impatient.endpoint),
            *(impatient.public, impatient.client_key, str(repository)),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert (client.stdout.readline(), impatient.jails()) == (b"ready\n", 1)
    os.kill(client.pid, signal.SIGKILL)
    client.communicate()
    assert eventually(lambda: impatient.jails() == 0)

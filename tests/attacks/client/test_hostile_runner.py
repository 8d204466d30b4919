"""A hostile runner in a real jail: the repository replaces our code next to it, and lies.
Jail and repository share a process, so that nothing our code does there can be relied on. What
counts is what the server and the client make of it: the same under every profile."""

import os
import pickle
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cloudpickle
import numpy as np
import pytest

from envhub_sandbox import errors, make_env
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from tests.attacks.client.lies import GROWTH, MIB, Canary, peak_growth
from tests.attacks.client.lying_server import step_done
from tests.attacks.harness import TIMEOUTS, Arena
from tests.attacks.repositories import write_environment
from tests.support import inside
from tests.support.processes import most_grown, resident
from tests.support.wire import value

_ENV = """
import os, pickle, socket, stat, struct, time
from envhub_worker.runner import runner
from envhub_worker.protocol import messages as m

honest = runner.Runner.answer
told = {}

class Three(Plain):
    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        told.update(options)
        return super().reset(seed=seed)

def lie(self, packet):
    request = m.unpack(packet.frames)
    if isinstance(request, m.Attach):
        list(map(os.close, self.descriptors))
        return m.pack(m.Value(False))  # so that steps come as messages
    if not isinstance(request, m.Step):
        return honest(self, packet)
    if "frames" in told:
        with open(told["frames"], "rb") as file:
            return pickle.load(file)
    if told["mode"] == "silence":
        time.sleep(600)
    if told["mode"] == "exit":
        os._exit(0)
    answer = m.pack(m.Value(None))
    stream = next(fd for fd in range(3, 64) if is_stream(fd))
    one = b"".join(map(bytes, runner.pack_packet(packet.request_id, answer)))
    if told["mode"] == "twice":
        os.write(stream, one)
    if told["mode"] == "other id":
        return_id = packet.request_id + 1
        os.write(stream, b"".join(map(bytes, runner.pack_packet(return_id, answer))))
    if told["mode"] == "dribble":
        for byte in one[:8]:
            os.write(stream, bytes([byte]))
            time.sleep(0.05)
        time.sleep(600)
    return answer

def is_stream(fd):
    try:
        return stat.S_ISSOCK(os.fstat(fd).st_mode)
    except OSError:
        return False

runner.Runner.answer = lie
"""
BOMBS: dict[str, list[Buffer]] = {
    "a header of noise": [os.urandom(1000)],
    "four million empty maps": value(
        b"\xdd" + (4_000_000).to_bytes(4, "big") + b"\x80" * 4_000_000
    ),
    "lists a million deep": value(b"\x91" * 1_000_000 + b"\xc0"),
    "an array that claims four billion": value(b"\xdd\xff\xff\xff\xff"),
    "four thousand frames": [*m.pack(m.Value(None)), *[b"x"] * 4000],
    "a frame too many": [*m.pack(step_done()), b"x" * MIB],
    "a wrong shape": m.pack(step_done(observation=np.zeros((2, 99), np.float32))),
    "the server's own words": m.pack(m.JailOpened(1, (1,), ())),
}
PLACES = ("observation", "rewards", "info")
_TEXTS = """
from envhub_worker.runner.sync_envs import Batch

class Words(Plain):
    observation_space = gym.spaces.Text(5)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        return "first", {}

    def step(self, action):
        forms = [honest, lambda batch: ("later",), lambda batch: ["later"] * 2]
        Batch.observation = forms[action]
        return "later", 0.0, False, False, {}

honest = Batch.observation
"""


@pytest.fixture(scope="module")
def canary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that is not there, as long as no pickle is loaded."""
    return tmp_path_factory.mktemp("canary") / "executed"


@pytest.fixture(scope="module")
def liar(warm_server: None, open_ground: Path, canary: Path) -> Iterator[Any]:
    """An environment whose runner lies about steps as the options of a reset say."""
    folder = write_environment(open_ground / "liar", _ENV)
    lies = dict(BOMBS)
    for place in PLACES:
        evil: Any = Canary(canary)
        done = step_done(**{place: {"a": evil} if place == "info" else evil})
        lies[place] = m.pack(done, pickler=cloudpickle.dumps)
        assert any(str(canary).encode() in bytes(frame) for frame in lies[place])
    for name, frames in lies.items():
        (folder / name).write_bytes(pickle.dumps([bytes(frame) for frame in frames]))
    policy = {"restart": "on_reset", "restart_backoff_s": 0, "restart_budget": 1000}
    options: dict[str, Any] = {"policy": {**policy, "lane": "frames"}, "timeouts": TIMEOUTS}
    with make_env(str(folder), n_envs=2, **options) as suites:
        yield suites.env


def told_lies(env: Any, **lie: str) -> tuple[Exception, int]:
    """The error of a step in which its runner lies, and by how much the server grew."""
    env.reset(options=lie)
    before = resident()
    del before[os.getpid()]
    with pytest.raises(errors.EnvHubError) as caught:
        env.step([0, 0])
    return caught.value, most_grown(before)


@pytest.fixture(scope="module")
def neighbour(warm_server: None) -> Iterator[Any]:
    """An honest environment in the same server."""
    with Arena("strict", "").environment() as env:
        env.reset()
        yield env


@pytest.fixture(autouse=True)
def _noticed_by_nobody(neighbour: Any) -> Iterator[None]:
    yield
    neighbour.step([0])


@pytest.mark.short
@pytest.mark.parametrize("place", PLACES)
def test_pickles_from_a_jail_are_never_loaded(liar: Any, canary: Path, place: str) -> None:
    told_lies(liar, frames=place)
    assert not canary.exists()


def test_the_control_loads_a_pickle(tmp_path: Path) -> None:
    pickle.loads(cloudpickle.dumps(Canary(tmp_path / "executed")))
    assert (tmp_path / "executed").exists()


@pytest.mark.short
@pytest.mark.parametrize("what", BOMBS)
def test_bombs_from_a_jail_are_refused(liar: Any, what: str) -> None:
    """Whatever frames a jail sends, client and server refuse them in bounded memory."""
    found: list[tuple[Exception, int]] = []
    client_grew = peak_growth(lambda: found.append(told_lies(liar, frames=what)))
    _, server_grew = found[0]
    assert client_grew < GROWTH
    assert server_grew < GROWTH


def test_an_observation_is_checked_once_its_form_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later ones of a form that was checked are not checked again: a form has no other values."""
    check = Mock(side_effect=Results.step)
    monkeypatch.setattr(Results, "step", lambda *args: check(*args))
    policy = {"restart": "on_reset", "restart_backoff_s": 0}
    options: dict[str, Any] = {"num_workers": 1, "policy": policy}
    with make_env(str(write_environment(tmp_path, _TEXTS)), 2, **options) as suites:
        for lie in (1, 2):
            suites.env.reset()
            check.reset_mock()
            for _ in range(30):
                assert suites.env.step([0, 0])[0] == ("later", "later")
            assert check.call_count < 10
            with pytest.raises(errors.RemoteProtocolError, match="not a batch of Text"):
                suites.env.step([lie, lie])


@pytest.mark.parametrize("mode", ["twice", "other id", "exit"])
def test_rule_breakers_lose_their_jail(liar: Any, mode: str) -> None:
    """Two answers, another id, no answer at all: the environment is dead, in plain words."""
    error, _ = told_lies(liar, mode=mode)
    if mode == "twice" and isinstance(error, errors.RemoteProtocolError):
        return  # the first answer came alone, and was of a wrong kind
    assert isinstance(error, errors.WorkerDiedError)
    assert error.reason == ("exit" if mode == "exit" else "protocol")


@pytest.mark.parametrize("mode", ["silence", "dribble"])
def test_silence_from_a_jail_ends_at_the_deadline(
    liar: Any, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A runner that does not answer, or a byte at a time, costs the time that was given."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 0.0)
    started = time.monotonic()
    with inside.hurried(liar, step_s=0.5):
        error, _ = told_lies(liar, mode=mode)
    assert isinstance(error, errors.WorkerTimeoutError)
    assert time.monotonic() - started < TIMEOUTS["step_s"]
    liar.reset(options={"mode": "nothing"})

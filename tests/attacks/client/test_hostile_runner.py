"""A hostile runner in a real jail: the repository replaces our code next to it, and lies.

Jail and repository share a process, so that nothing our code does there can be relied on. What
counts is what the server and the client make of it.
"""

from __future__ import annotations

import os
import pickle
import time
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import (
    EnvHubError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerTimeoutError,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from tests.attacks.client.lies import Canary, peak_growth
from tests.attacks.client.lying_server import step_done
from tests.attacks.harness import TIMEOUTS, Arena
from tests.attacks.repositories import write_environment
from tests.support.processes import most_grown, resident
from tests.support.wire import value

FAMILY = "The client, from inside a jail"

MIB = 1 << 20
GROWTH = 192 * MIB

_ENV = """
import os, socket, struct, time
from envhub_worker.runner import runner
from envhub_worker.protocol import messages as m

FRAMES = {frames!r}
MODE = {mode!r}
honest = runner.Runner.answer

class Three(Plain):
    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)

def lie(self, packet):
    request = m.unpack(packet.frames)
    if isinstance(request, m.Attach):
        list(map(os.close, self.descriptors))
        return m.pack(m.Value(False))  # so that steps come as messages
    if not isinstance(request, m.Step):
        return honest(self, packet)
    if MODE == "frames":
        return FRAMES
    if MODE == "silence":
        time.sleep(600)
    if MODE == "exit":
        os._exit(0)
    answer = m.pack(m.Value(None))
    stream = next(fd for fd in range(3, 64) if is_stream(fd))
    one = b"".join(map(bytes, runner.pack_packet(packet.request_id, answer)))
    if MODE == "twice":
        os.write(stream, one)
    if MODE == "other id":
        return_id = packet.request_id + 1
        os.write(stream, b"".join(map(bytes, runner.pack_packet(return_id, answer))))
    if MODE == "dribble":
        for byte in one[:8]:
            os.write(stream, bytes([byte]))
            time.sleep(0.05)
        time.sleep(600)
    return answer

def is_stream(fd):
    import stat
    try:
        return stat.S_ISSOCK(os.fstat(fd).st_mode)
    except OSError:
        return False

runner.Runner.answer = lie
"""


def liar(folder: Path, mode: str, frames: list[Buffer] | None = None) -> str:
    """A repository whose runner lies about steps."""
    raw = [bytes(frame) for frame in frames or []]
    return str(write_environment(folder / "liar", _ENV.format(frames=raw, mode=mode)))


def lies_to(arena: Arena, folder: str, **timeouts: float) -> tuple[Exception, int]:
    """The error of a step of a lying repository, and by how much the server grew."""
    options: dict[str, Any] = {"lane": "frames", "policy": {"profile": arena.profile}}
    options["timeouts"] = {**TIMEOUTS, **timeouts}
    with make_env(folder, n_envs=2, **options) as suites:
        suites.env.reset()
        before = resident()
        del before[os.getpid()]
        with pytest.raises(EnvHubError) as caught:
            suites.env.step([0, 0])
        grown = most_grown(before)
    return caught.value, grown


@pytest.fixture
def neighbour(arena: Arena) -> Any:
    """An honest environment in the same server, which must not notice anything."""
    with arena.environment() as env:
        env.reset()
        yield env
        env.step([0])


@pytest.mark.short("strict")
@pytest.mark.parametrize(
    "place", ["observation", "rewards", "info"], ids=["observation", "rewards", "info"]
)
def test_pickles_from_a_jail_are_never_loaded(
    arena: Arena, neighbour: Any, home: Path, place: str
) -> None:
    """A pickle that a jail sends is refused by the client, which loads none."""
    canary = home / "executed"
    evil: Any = Canary(canary)
    done = step_done(**{place: {"a": evil} if place == "info" else evil})
    frames = m.pack(done, pickler=cloudpickle.dumps)
    assert any(str(canary).encode() in bytes(frame) for frame in frames)
    lies_to(arena, liar(home, "frames", frames))
    assert not canary.exists()
    pickle.loads(cloudpickle.dumps(evil))
    assert canary.exists(), "the control failed: loaded, the pickle does nothing"


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


@pytest.mark.short("strict")
@pytest.mark.parametrize("what", list(BOMBS))
def test_bombs_from_a_jail_are_refused(arena: Arena, neighbour: Any, home: Path, what: str) -> None:
    """Whatever frames a jail sends, client and server refuse them in bounded memory."""
    found: list[tuple[Exception, int]] = []
    folder = liar(home, "frames", BOMBS[what])
    client_grew = peak_growth(lambda: found.append(lies_to(arena, folder)))
    _, server_grew = found[0]
    assert client_grew < GROWTH
    assert server_grew < GROWTH


@pytest.mark.parametrize("mode", ["twice", "other id", "exit"])
def test_rule_breakers_lose_their_jail(arena: Arena, neighbour: Any, home: Path, mode: str) -> None:
    """Two answers, another id, no answer at all: the environment is dead, in plain words."""
    error, _ = lies_to(arena, liar(home, mode))
    if mode == "twice" and isinstance(error, RemoteProtocolError):
        return  # the first answer came alone, and was of a wrong kind
    assert isinstance(error, WorkerDiedError)
    assert error.reason == ("exit" if mode == "exit" else "protocol")


@pytest.mark.parametrize("mode", ["silence", "dribble"])
def test_silence_from_a_jail_ends_at_the_deadline(
    arena: Arena, neighbour: Any, home: Path, mode: str
) -> None:
    """A runner that does not answer, or a byte at a time, costs the time that was given."""
    started = time.monotonic()
    error, _ = lies_to(arena, liar(home, mode), step_s=0.5, close_s=0.5)
    assert isinstance(error, WorkerTimeoutError)
    assert time.monotonic() - started < TIMEOUTS["step_s"]

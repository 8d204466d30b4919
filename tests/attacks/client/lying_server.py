"""A worker server that speaks the wire and lies; a sandbox that leads the client to it.
It answers honestly, for a repository with one environment, except for the requests that a test
has a lie for. Runs in a thread of the test: what it allocates is small, so that memory that the
client is made to take shows."""

import contextlib
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from gymnasium import spaces

from envhub_sandbox.sandboxes.pool import WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.manifest.manifest import (
    EnvManifest,
    Manifest,
    encode_env,
    encode_manifest,
)
from envhub_worker.protocol.runtime import OWN, Runtime
from tests.support import wire

Frames = list[Buffer]
NUM_ENVS = 2
OBSERVATION = spaces.Box(-1, 1, (3,), np.float32)
ACTION = spaces.Discrete(2)
Lie = Callable[["Asked"], list[Frames]]
"""All the messages that go out instead of the honest one."""


@dataclass(frozen=True)
class Asked:
    """A request, and what an honest server would answer."""

    request_id: int
    request: m.Message
    relayed: bool
    honest: m.Message

    def answer(self, message: m.Message | Frames, request_id: int | None = None) -> Frames:
        """An answer to this request: the server's own, or the runner's wrapped as it is relayed."""
        number = self.request_id if request_id is None else request_id
        if not self.relayed:
            assert isinstance(message, m.Message)
            return m.pack_header(message, number)
        frames = m.pack(message) if isinstance(message, m.Message) else message
        [header] = m.pack(m.RelayDone((len(frames),)))
        return m.with_id(header, number, frames)


@dataclass(eq=False)
class LyingServer(WorkerServer):
    """What ``Sandbox.acquire`` gives; lies are looked up by the type of the request."""

    lies: dict[type[m.Message], Lie] = field(default_factory=dict)
    runs: bool = True
    asked: list[m.Message] = field(default_factory=list)
    heard: bytearray = field(default_factory=bytearray)
    """Every byte that a client sent: what a hostile worker knows by then."""

    def __post_init__(self) -> None:
        self.folder = tempfile.mkdtemp(prefix="envhub-liar-")
        self.endpoint = f"ipc://{self.folder}/server"
        self.process_fd, self._alive = os.pipe()
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        self._router.setsockopt(zmq.LINGER, 0)
        self._router.bind(self.endpoint)
        self._stopped = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped:
            if self._router.poll(50):
                with contextlib.suppress(zmq.ZMQError):
                    identity, *frames = self._router.recv_multipart()
                    for answer in self._answers(frames):
                        self._router.send_multipart([identity, *answer])

    def _answers(self, frames: list[bytes]) -> list[Frames]:
        self.heard += b"".join(frames)
        request_id, request, payload = m.unpack_with_id(frames)
        relayed = isinstance(request, m.Relay)
        if relayed and not request.stepped:
            request = m.unpack(payload, unpickler=lambda data: data)
        self.asked.append(request)
        asked = Asked(request_id, request, relayed, honest(request))
        lie = self.lies.get(type(request))
        return lie(asked) if lie else [asked.answer(asked.honest)]

    def stop(self) -> None:
        self._stopped = True
        self._thread.join()
        self._router.close()
        self._context.term()
        os.close(self._alive)
        os.close(self.process_fd)
        shutil.rmtree(self.folder, ignore_errors=True)


class LyingSandbox(Sandbox):
    """A place for workers that has only the liar."""

    name = "liar"

    def __init__(self, server: LyingServer) -> None:
        self._server = server

    def acquire(self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0) -> Any:
        return LyingUse(self._server)


@dataclass
class LyingUse:
    """One use of the liar, which the test ends."""

    server: LyingServer
    live: bool = True

    def release(self) -> None:
        self.live = False


@contextmanager
def lying() -> Iterator[LyingServer]:
    server = LyingServer()
    try:
        yield server
    finally:
        server.stop()


def env_manifest(**changes: Any) -> EnvManifest:
    honest = {"sync": True, "type_name": "gymnasium.vector.SyncVectorEnv"}
    return wire.env_manifest(OBSERVATION, ACTION, NUM_ENVS, **(honest | changes))


def manifest() -> dict[str, Any]:
    return encode_manifest(Manifest(envs=(env_manifest(),), lazy=True))


def step_done(**changes: Any) -> m.StepDone:
    fields: dict[str, Any] = {
        "observation": np.zeros((NUM_ENVS, 3), np.float32),
        "rewards": np.zeros(NUM_ENVS),
        "terminations": np.zeros(NUM_ENVS, bool),
        "truncations": np.zeros(NUM_ENVS, bool),
        "info": {},
    }
    return m.StepDone(**(fields | changes))


def honest(request: m.Message) -> m.Message:
    """What an honest server or runner answers."""
    if isinstance(request, (m.Reset, m.Step)):
        done = step_done()
        return done if isinstance(request, m.Step) else m.ResetDone(done.observation, {})
    answers: dict[type[m.Message], Callable[[], m.Message]] = {
        m.Hello: lambda: m.Welcome(m.VERSION, "0", os.getpid()),
        m.OpenJail: lambda: m.JailOpened(1, (1,), ()),
        m.StartRunners: lambda: m.JailOpened(1, (2,), ()),
        m.ShareSlabs: lambda: m.Refusal("WorkerError", "it takes no steps itself", "", ""),
        m.CloseJail: lambda: m.Done(),
        m.CheckJail: lambda: m.Done(),
        m.GetStatus: lambda: m.Status(()),
        m.Load: lambda: m.LoadDone(manifest()),
        m.LoadTask: lambda: m.Value((NUM_ENVS, True)),
        m.Build: lambda: m.BuildDone(encode_env(env_manifest())),
        m.Call: lambda: m.Value((None,) * NUM_ENVS),
    }
    return answers.get(type(request), lambda: m.Value(None))()

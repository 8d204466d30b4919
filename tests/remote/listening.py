"""A listening worker server of our own, and what it said."""

import argparse
import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest

import envhub_worker.protocol
from envhub_sandbox import RemoteSandbox
from envhub_worker.extras.access.commands import status
from tests.support import inside
from tests.support.processes import eventually
from tests.support.repositories import STILL, write_repository

_BOOTSTRAP = Path(envhub_worker.protocol.__file__).parent.parent / "bootstrap.py"
ANY_PORT = "tcp://127.0.0.1:*"
WORKER = (sys.executable, "-I", str(_BOOTSTRAP), "worker")


def worker(*words: object, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
    """What ``envhub-worker`` says to these words, and how it ends."""
    command = [*WORKER, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


# counts its steps, so that everybody sees whether it is still the same one
COUNTING = """
import time

class Counting(Still):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(100)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {}
    def step(self, action):
        time.sleep(int(action) / 10)
        self.count += 1
        return np.full(1, self.count, np.float32), 0.0, False, False, {}
"""


def counting(folder: Path, *, files: dict[str, bytes] | None = None) -> Path:
    """A repository whose action says how many tenths of a second a step takes."""
    write_repository(folder, STILL + COUNTING)
    for name, data in (files or {}).items():
        (folder / name).write_bytes(data)
    return folder


@dataclass
class Listening:
    """A running server."""

    process: subprocess.Popen[bytes]
    endpoint: str
    public: str
    state: Path
    log: Path
    client_key: str = field(repr=False, default="")

    @property
    def port(self) -> int:
        return int(self.endpoint.rpartition(":")[2])

    def sandbox(self, **changes: Any) -> RemoteSandbox:
        """The client's side; ``changes`` are wrong on purpose."""
        options = {"server_key": self.public, "client_key": self.client_key, **changes}
        return RemoteSandbox(options.pop("endpoint", self.endpoint), **options)

    def said(self) -> str:
        return self.log.read_text("utf-8", "replace")

    def noted(self) -> str:
        note = self.state / "endpoint"
        return note.read_text() if note.exists() else ""

    def memory(self) -> int:
        return int(psutil.Process(self.process.pid).memory_info().rss)

    def sessions(self) -> list[dict[str, Any]]:
        """Those that it has; the asker's is not among them."""
        return self.status()["sessions"]

    def status(self) -> dict[str, Any]:
        asked = argparse.Namespace(state_dir=self.state, endpoint=None, json=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(*inside.STATUS_WAIT_MS, 60_000)  # an operator waits less
            patch.setattr("sys.stdout", said := io.StringIO())
            assert status.run(asked) == 0
        return json.loads(said.getvalue())

    def as_client(self) -> tuple[str, ...]:
        """Options by which ``envhub-worker`` asks this server with its client's key."""
        key = str(self.state / "client.key")
        return "--endpoint", self.endpoint, "--server-key", self.public, "--key", key

    def jails(self) -> int:
        return sum(len(one["jails"]) for one in self.sessions())

    def open_jails(self) -> set[tuple[str, int]]:
        """Which ones: the name of a session, and a number."""
        return {(one["session"], jail["jail"]) for one in self.sessions() for jail in one["jails"]}


@contextlib.contextmanager
def listening(
    folder: Path, *options: str, bind: str = ANY_PORT, prefix: Sequence[str] = ()
) -> Iterator[Listening]:
    """Start a server and end it; ``prefix`` runs it elsewhere."""
    folder.mkdir(parents=True, exist_ok=True)
    state, log = folder / "state", folder / "log"
    arguments = [*prefix, *WORKER, "listen", "--bind", bind, "--state-dir", str(state), *options]
    with log.open("wb") as out:
        process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=out, stderr=out)
    server = Listening(process, "", "", state, log)
    try:
        assert eventually(lambda: server.noted().endswith("\n") or process.poll() is not None)
        assert process.poll() is None, server.said()
        # for programs, and with a list of clients, it says nothing that a client is to paste
        assert "json" in options or eventually(lambda: "sandbox=" in server.said())
        server.endpoint, server.public, _ = server.noted().split(" ", 2)
        key = state / "client.key"
        server.client_key = key.read_text().strip() if key.exists() else ""
        yield server
    finally:
        server.process.terminate()  # a test may have started another in its place
        server.process.wait(120)

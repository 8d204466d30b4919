"""What short clients, one after the other, leave behind in a server.

``python -m tests.faults.endurance.clients [--in-a-row 1000]`` starts a server on loopback. Each
client is a process of its own, which opens an environment, steps and goes. After a tenth of them
and at the end it is looked at what the server has, and nothing may be more. Exits with 1 if
something grew.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil

from envhub_sandbox import RemoteSandbox, make_env
from tests.remote.listening import ANY_PORT, Listening, listening, worker
from tests.support.processes import eventually
from tests.support.samples import sample

_REPOSITORY = sample("cartpole")
_STEPS = 3
_MIB = 1 << 20
SLACK = {"server_pss_mib": 8.0, "descriptors": 8, "threads": 1}
"""By how much the server may differ between two looks; all else is to be as it was."""
_SETTLE_S = 60.0
_PAUSE_S = 1.0
_RETRY_S = 600.0
MEMORY = {"limits": {"memory_bytes": 1 << 30}}
"""A policy by which many are within the quota of one client."""


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--in-a-row", type=int, default=1000)
    parser.add_argument("--client", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args(words)
    if arguments.client:
        return _client(*arguments.client)
    with tempfile.TemporaryDirectory(prefix="clients-") as folder, serving(Path(folder)) as server:
        found = in_a_row(server, arguments.in_a_row)
    grown = more(found["after_a_tenth"], found["at_the_end"])
    print(json.dumps({**found, "grown": grown}, indent=2))
    return 1 if grown else 0


def more(
    before: Mapping[str, float], after: Mapping[str, float], slack: Mapping[str, float] = SLACK
) -> list[str]:
    """Of what there is more, beyond what one look differs from the next."""
    return [name for name, value in after.items() if value > before[name] + slack.get(name, 0)]


def in_a_row(server: Server, count: int) -> dict[str, Any]:
    """Short clients, one after the other."""
    begun, tenth = time.perf_counter(), max(1, count // 10)
    for _ in range(tenth):
        server.short()
    before = server.settled()
    for _ in range(count - tenth):
        server.short()
    taken = time.perf_counter() - begun
    each = {"clients": count, "seconds_each": round(taken / count, 2)}
    return {**each, "after_a_tenth": before, "at_the_end": server.settled(before)}


def _client(endpoint: str, server_key: str) -> int:
    """One client: its secret key is in its environment."""
    sandbox = RemoteSandbox(endpoint, server_key, retry_s=_RETRY_S)
    with make_env(_REPOSITORY, sandbox=sandbox, policy=MEMORY) as suites:
        suites.env.reset(seed=0)
        for _ in range(_STEPS):
            suites.env.step(suites.env.action_space.sample())
    return 0


class Server:
    """A server on loopback."""

    def __init__(self, listens: Listening, place: Path) -> None:
        self._listens, self.place = listens, place
        self.endpoint = listens.endpoint

    @property
    def process(self) -> subprocess.Popen[bytes]:
        return self._listens.process

    def killed_and_started(self) -> None:
        """End it without a warning, and start another at its address, with its keys."""
        self.process.kill()
        self.process.wait()
        words = [self.endpoint if word == ANY_PORT else word for word in self.process.args]
        self._listens.process = subprocess.Popen(words, stdin=subprocess.DEVNULL)
        asks = ("health", "--state-dir", self._listens.state)
        assert eventually(lambda: worker(*asks).returncode == 0)

    def sandbox(self) -> RemoteSandbox:
        return self._listens.sandbox(retry_s=_RETRY_S)

    def short(self) -> None:
        """A client that comes, steps and goes."""
        command = [sys.executable, "-m", "tests.faults.endurance.clients"]
        words = ["--client", self.endpoint, self._listens.public]
        cache = self.place.with_name("cache")
        variables = {"ENVHUB_CLIENT_KEY": self._listens.client_key, "ENVHUB_CACHE": str(cache)}
        subprocess.run([*command, *words], check=True, env=os.environ | variables, timeout=600)

    def settled(self, before: Mapping[str, float] | None = None) -> dict[str, float]:
        """What it has, once all clients have gone: waits for their ends, but not for ever."""
        end, last = time.monotonic() + _SETTLE_S, dict[str, float]()
        while True:
            now = self._look()
            quiet = not now["jails"] and now["processes"] == last.get("processes")
            if (quiet and not (before and more(before, now))) or time.monotonic() > end:
                return now
            last = now
            time.sleep(_PAUSE_S)

    def _look(self) -> dict[str, float]:
        process = psutil.Process(self.process.pid)
        return {
            "server_pss_mib": round(process.memory_full_info().pss / _MIB, 1),
            "descriptors": process.num_fds(),
            "threads": process.num_threads(),
            "processes": len(process.children(recursive=True)),
            "jails": self._listens.jails(),
            "folders": entries(self.place),
            "stored_files": entries(self._listens.state / "store"),
        }


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[Server]:
    place = folder / "place"
    place.mkdir(mode=0o711)
    folder.chmod(0o711)
    options = ("--max-sessions", "1024", "--max-jails", "256", "--log-level", "error")
    with listening(folder, *options, prefix=("env", f"TMPDIR={place}")) as listens:
        yield Server(listens, place)


def entries(folder: Path) -> int:
    """What is below a folder, of which some goes while one looks."""
    return sum(len(folders) + len(files) for _, folders, files in os.walk(folder))


if __name__ == "__main__":
    raise SystemExit(main())

"""A server under many clients: what they take at once, and what short ones leave behind.

``python -m benchmarks.clients [--in-a-row 1000] [--at-once 50] [--environments 64]`` starts a
server on loopback. Each client is a process of its own. First so many short ones come one after the
other, each opens an environment, steps and goes: after a tenth of them and at the end it is looked
at what the server has, and nothing may be more. Then many are there at once, and then one with many
environments: memory is PSS, so that what processes share is counted once. Exits with 1 if something
grew.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.sandboxes.process import BOOTSTRAP

_REPOSITORY = Path(__file__).parent / "repositories" / "cartpole"
_STEPS = 3
_MIB = 1 << 20
_SLACK = {"server_pss_mib": 8.0, "descriptors": 8, "threads": 1}
"""By how much the server may differ between two looks; all else is to be as it was."""
_SETTLE_S = 60.0
_PAUSE_S = 1.0
_RETRY_S = 600.0
MEMORY = {"limits": {"memory_bytes": 1 << 30}}
"""A policy by which many are within the quota of one client."""


def main(words: Sequence[str] | None = None) -> int:
    """Run what was asked for; prints one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--in-a-row", type=int, default=1000)
    parser.add_argument("--at-once", type=int, default=50)
    parser.add_argument("--environments", type=int, default=64)
    parser.add_argument("--client", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args(words)
    if arguments.client:
        return _client(*arguments.client)
    with tempfile.TemporaryDirectory(prefix="clients-") as folder, Server(Path(folder)) as server:
        found: dict[str, Any] = {}
        if arguments.in_a_row:
            found["in_a_row"] = in_a_row(server, arguments.in_a_row)
        if arguments.at_once:
            found["at_once"] = at_once(server, arguments.at_once, 1)
        if arguments.environments:
            found["environments"] = at_once(server, 1, arguments.environments)
    grown = grows(found["in_a_row"]) if arguments.in_a_row else []
    print(json.dumps({**found, "grown": grown}, indent=2))
    return 1 if grown else 0


def grows(found: dict[str, Any]) -> list[str]:
    """What the server has more of at the end than after the first tenth."""
    return more(found["after_a_tenth"], found["at_the_end"])


def more(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Of what there is more, beyond what one look differs from the next."""
    return [name for name, value in after.items() if value > before[name] + _SLACK.get(name, 0)]


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


def at_once(server: Server, clients: int, environments: int) -> dict[str, Any]:
    """Clients that are all there, each with so many environments; and that they have gone."""
    server.settled()
    begun = time.perf_counter()
    with contextlib.ExitStack() as stack:
        running = [stack.enter_context(server.client(environments)) for _ in range(clients)]
        # all of them are read, so that one that is slow keeps no other from saying so
        for one in running:
            assert one.stdout is not None
            if one.stdout.readline() != b"ready\n":
                raise RuntimeError("a client has failed; see what it printed")
        taken = time.perf_counter() - begun
        ours = sum(map(_pss, running))
        return {
            "clients": clients,
            "environments_each": environments,
            "seconds_until_all_stepped": round(taken, 1),
            "server_pss_mib": _mib(_pss(server.process)),
            "jails_pss_mib": _mib(_below(server.process)),
            "clients_pss_mib": _mib(ours),
            "processes": len(psutil.Process(server.process.pid).children(recursive=True)),
        }


def _client(endpoint: str, server_key: str, environments: str, stays: str) -> int:
    """One client: its secret key is in its environment."""
    sandbox = RemoteSandbox(endpoint, server_key, retry_s=_RETRY_S)
    with contextlib.ExitStack() as stack:
        for number in range(int(environments)):
            suites = make_env(_REPOSITORY, sandbox=sandbox, policy=MEMORY)
            env = stack.enter_context(suites).env
            env.reset(seed=number)
            for _ in range(_STEPS):
                env.step(env.action_space.sample())
        if int(stays):
            print("ready", flush=True)
            sys.stdin.read()
    return 0


class Server:
    """A server on loopback, with a temporary folder of its own."""

    def __init__(self, folder: Path, *options: str) -> None:
        self._folder = folder
        self._state, self._place = folder / "state", folder / "place"
        self._place.mkdir(mode=0o711)
        folder.chmod(0o711)
        self._options = options
        self._endpoint = "tcp://127.0.0.1:*"
        self._start()
        self._public = (self._state / "server.pub").read_text().strip()
        self._variables = {
            **os.environ,
            "ENVHUB_CLIENT_KEY": str(self._state / "client.key"),
            "ENVHUB_CACHE": str(folder / "cache"),
        }

    def _start(self) -> None:
        command = [sys.executable, "-I", str(BOOTSTRAP), "worker", "listen"]
        options = ["--bind", self._endpoint, "--state-dir", str(self._state), *self._options]
        more = ["--max-sessions", "1024", "--max-jails", "256", "--log-level", "error"]
        variables = {**os.environ, "TMPDIR": str(self._place)}
        self.process = subprocess.Popen(
            [*command, *options, *more], stdout=subprocess.PIPE, env=variables, text=True
        )
        assert self.process.stdout is not None
        said = ""
        while "ENVHUB_SERVER_KEY" not in said:
            line = self.process.stdout.readline()
            if not line:
                raise RuntimeError(f"the server has ended: {said}")
            said += line
        threading.Thread(target=self.process.stdout.read, daemon=True).start()
        found = re.search(r"tcp://\S+", said)
        assert found is not None
        self._endpoint = found[0]

    def killed_and_started(self) -> None:
        """End it without a warning, and start another at its address, with its keys."""
        self.process.kill()
        self.process.wait()
        self._start()

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return self._endpoint

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(60)

    @property
    def place(self) -> Path:
        """Its folder for temporary files."""
        return self._place

    def sandbox(self) -> RemoteSandbox:
        """The way to it, for this process."""
        return RemoteSandbox(
            self._endpoint,
            self._public,
            (self._state / "client.key").read_text(),
            retry_s=_RETRY_S,
        )

    def _command(self, environments: int, *, stays: bool) -> list[str]:
        words = [self._endpoint, self._public, str(environments), str(int(stays))]
        return [sys.executable, "-m", "benchmarks.clients", "--client", *words]

    def short(self) -> None:
        """A client that comes, steps and goes."""
        subprocess.run(self._command(1, stays=False), check=True, env=self._variables, timeout=600)

    @contextlib.contextmanager
    def client(self, environments: int) -> Iterator[subprocess.Popen[bytes]]:
        """A client that says when it has stepped, and stays until then."""
        pipe = subprocess.PIPE
        command = self._command(environments, stays=True)
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, env=self._variables) as process:
            try:
                yield process
            finally:
                process.communicate(timeout=600)

    def settled(self, before: Mapping[str, float] | None = None) -> dict[str, float]:
        """What it has, once all clients have gone: waits for their ends, but not for ever.

        Args:
            before: What it had earlier; it is also waited for what is more than that.
        """
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
            "server_pss_mib": _mib(_pss(self.process)),
            "descriptors": process.num_fds(),
            "threads": process.num_threads(),
            "processes": len(process.children(recursive=True)),
            "jails": self._jails(),
            "folders": entries(self._place),
            "stored_files": entries(self._state / "store"),
        }

    def _jails(self) -> int:
        command = [sys.executable, "-I", str(BOOTSTRAP), "worker", "status", "--json"]
        command += ["--state-dir", str(self._state)]
        done = subprocess.run(command, check=True, capture_output=True, timeout=120)
        return sum(len(one["jails"]) for one in json.loads(done.stdout)["sessions"])


def _below(process: subprocess.Popen[Any]) -> int:
    found = 0
    for child in psutil.Process(process.pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            found += child.memory_full_info().pss
    return found


def entries(folder: Path) -> int:
    """What is below a folder, of which some goes while one looks."""
    return sum(len(folders) + len(files) for _, folders, files in os.walk(folder))


def _pss(process: subprocess.Popen[Any]) -> int:
    return int(psutil.Process(process.pid).memory_full_info().pss)


def _mib(size: int) -> float:
    return round(size / _MIB, 1)


if __name__ == "__main__":
    raise SystemExit(main())

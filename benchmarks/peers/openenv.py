"""OpenEnv: one server over HTTP and WebSockets, one session for each sub-environment."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import time
from typing import Any

from openenv.core.generic_client import GenericEnvClient

from benchmarks.workloads import Workload

_READY_S = 60.0


def open_peer(workload: Workload, count: int) -> Sessions:
    """A server of its own, and ``count`` sessions that step at the same time."""
    return Sessions(workload.name, count)


class Sessions:
    """What an OpenEnv client has to do for a vector step: gather one step of each session."""

    def __init__(self, name: str, count: int) -> None:
        port = _free_port()
        server = [sys.executable, "-m", "benchmarks.peers.openenv_server", name, str(port)]
        self._server = subprocess.Popen([*server, str(count)], stdin=subprocess.DEVNULL)
        self._loop = asyncio.new_event_loop()
        try:
            _wait_for(port, self._server)
            url = f"http://127.0.0.1:{port}"
            self._clients = [GenericEnvClient(base_url=url) for _ in range(count)]
            self._gather([client.reset(seed=index) for index, client in enumerate(self._clients)])
        except BaseException:
            self._server.kill()
            raise

    def _gather(self, waiting: list[Any]) -> list[Any]:
        async def gathered() -> list[Any]:
            return await asyncio.gather(*waiting)

        return self._loop.run_until_complete(gathered())

    def step(self, actions: Any) -> list[Any]:
        """One step of each session."""
        pairs = zip(self._clients, actions, strict=True)
        return self._gather([client.step({"action": int(action)}) for client, action in pairs])

    def close(self) -> None:
        """End the sessions and the server."""
        self._gather([client.close() for client in self._clients])
        self._server.terminate()
        self._server.wait(10)
        self._loop.close()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _wait_for(port: int, server: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + _READY_S
    while time.monotonic() < until:
        if server.poll() is not None:
            raise RuntimeError("the OpenEnv server ended")
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise TimeoutError("the OpenEnv server did not come up")
